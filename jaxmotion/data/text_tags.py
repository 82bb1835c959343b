"""Classes of tagged words, which T2M's text encoder takes beside the word vectors.

There are nine parts of speech, five classes of words that matter most for motion and
take the place of the part of speech (places, body parts, objects, actions, manners),
and one class for the rest.
"""

from collections.abc import Mapping

TAG_CLASSES = (
    "VERB",
    "NOUN",
    "DET",
    "ADP",
    "NUM",
    "AUX",
    "PRON",
    "ADJ",
    "ADV",
    "Loc_VIP",
    "Body_VIP",
    "Obj_VIP",
    "Act_VIP",
    "Desc_VIP",
    "OTHER",
)

# Our own choice, in lemmas. Evaluators with published weights were trained with lists
# of their own (some forty actions, a dozen of each other class): give them those.
SPECIAL_WORDS: Mapping[str, frozenset[str]] = {
    "Loc_VIP": frozenset(
        "left right forward backward back up down straight sideways clockwise "
        "counterclockwise".split()
    ),
    "Body_VIP": frozenset("arm hand leg foot knee head face waist shoulder".split()),
    "Obj_VIP": frozenset("ball chair floor stair wall box".split()),
    "Act_VIP": frozenset(
        "walk run dash sprint step jump turn bow wave punch kick slash throw dance "
        "raise lift lower sit stand bend".split()
    ),
    "Desc_VIP": frozenset(
        "happy happily sad sadly angry angrily proud proudly tired exhausted fast "
        "quickly slow slowly".split()
    ),
}


def tag_class(
    word: str, pos: str, *, special: Mapping[str, frozenset[str]] = SPECIAL_WORDS
) -> str:
    """Class of a tagged word.

    Args:
      word: The word as it stands in the tokens: nouns and verbs as lemmas.
      pos: Its part of speech, such as "NOUN".
      special: Words of the five special classes; they go before the part of speech.

    Returns:
      One of `TAG_CLASSES`; "OTHER" for parts of speech that have no class, such as
      CCONJ.

    Source: Guo et al. 2022 (T2M), part-of-speech classes.
    """
    for name, words in special.items():
        if word in words:
            return name
    return pos if pos in TAG_CLASSES else "OTHER"
