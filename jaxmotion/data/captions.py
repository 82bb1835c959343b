"""Captions for the labels of the Bandai-Namco sets: a small grammar.

Those sets label a clip with a content ("walk-turn-left") and a style ("elderly"). A
caption is one of four templates, filled with one of the words or phrases for each:

    adjective    a {adjective} {noun} {action}         an elderly person walks
    clause       someone {clause} {action}             someone who is very old walks
    manner       a {noun} {action} {manner}            a person walks like an old person
    progressive  a {noun} is {action + ing} {manner}   a person is walking like ...

Style "normal" has no adjective and no clause. Words are tagged as in HumanML3D: nouns
and verbs as lemmas, all others as they stand ("an/DET person/NOUN walk/VERB"); neither
punctuation nor hyphens occur. Labels are read as plain English. That is a guess for
"guide", "respond", "call", "musical" and "chimpira" (a young thug), which their
publisher does not explain.

Source: own.
"""

from collections.abc import Iterator, Sequence

import numpy as np

TEMPLATES = ("adjective", "clause", "manner", "progressive")
_PEOPLE = ("person", "figure")

# Base form, third person, -ing form.
_VERBS = {
    forms.split()[0]: forms.split()
    for forms in (
        "walk walks walking, run runs running, dash dashes dashing, "
        "sprint sprints sprinting, step steps stepping, bow bows bowing, "
        "say says saying, bid bids bidding, show shows showing, "
        "guide guides guiding, wave waves waving, respond responds responding, "
        "give gives giving, call calls calling, punch punches punching, "
        "throw throws throwing, kick kicks kicking, slash slashes slashing, "
        "make makes making, dance dances dancing, perform performs performing, "
        "turn turns turning, raise raises raising, lift lifts lifting"
    ).split(", ")
}
_OTHER_WORDS = {
    "DET": "a an the both no",
    "PRON": "someone who their",
    "AUX": "is",
    "ADP": "like with without in for of out as while",
    "CCONJ": "and",
    "SCONJ": "if",
    "PART": "not to",
    "ADJ": "happy cheerful sad unhappy angry furious proud arrogant insecure timid "
    "confident masculine manly feminine womanly childish childlike elderly old tired "
    "weary active energetic musical rhythmic gigantic huge great thuggish rowdy "
    "exhausted drained youthful young usual long short full",
    "ADV": "forward backward left right up sideways very proudly happily sadly angrily "
    "wearily energetically rhythmically normally",
    "NOUN": "person figure hand leg way head child confidence energy music rhythm "
    "giant weight thug time goodbye farewell answer",
}
# Word -> "lemma/POS".
_TAGS = {
    word: f"{word}/{pos}"
    for pos, words in _OTHER_WORDS.items()
    for word in words.split()
}
_TAGS |= {f: f"{base}/VERB" for base, (_, *forms) in _VERBS.items() for f in forms}
_TAGS |= {word: f"{word[:-1]}/VERB" for word in ("feels", "looks", "acts")}
_TAGS |= {"hands": "hand/NOUN"}

# Verbs stand in their base form and are inflected; word:POS stays as it is.
_CONTENTS = {
    "walk": ("walk", "walk forward"),
    "run": ("run", "run forward"),
    "dash": ("dash", "sprint"),
    "walk-back": ("walk backward", "step backward"),
    "walk-left": ("walk to:ADP the left:NOUN", "step sideways to:ADP the left:NOUN"),
    "walk-right": ("walk to:ADP the right:NOUN", "step sideways to:ADP the right:NOUN"),
    "bow": ("bow", "bow with the head"),
    "bye": ("say goodbye", "bid farewell"),
    "guide": ("guide someone", "show someone the way"),
    "byebye": ("wave goodbye", "wave to say:VERB goodbye"),
    "respond": ("respond", "give an answer"),
    "call": ("call someone", "call out to:ADP someone"),
    "punch": ("punch", "throw a punch:NOUN"),
    "kick": ("kick", "kick with one:NUM leg"),
    "slash": ("slash", "make a slash:NOUN"),
    "dance-long": ("dance for a long time", "perform a long dance:NOUN"),
    "dance-short": ("dance for a short time", "perform a short dance:NOUN"),
    "walk-turn-left": ("walk and turn left", "turn left while walking"),
    "walk-turn-right": ("walk and turn right", "turn right while walking"),
    "wave-both-hands": ("wave with both hands", "wave both hands"),
    "wave-left-hand": ("wave with the left:ADJ hand", "wave their left:ADJ hand"),
    "wave-right-hand": ("wave with the right:ADJ hand", "wave their right:ADJ hand"),
    "raise-up-both-hands": ("raise both hands", "lift both hands up"),
    "raise-up-left-hand": ("raise the left:ADJ hand", "lift their left:ADJ hand up"),
    "raise-up-right-hand": (
        "raise the right:ADJ hand",
        "lift their right:ADJ hand up",
    ),
}
# Adjectives; clauses; manners.
_MASCULINE = (
    ("masculine", "manly"),
    ("who is masculine", "who looks manly"),
    ("in a masculine way", "in a manly way"),
)
_OLD = (
    ("elderly", "old"),
    ("who is elderly", "who is very old"),
    ("in an elderly way", "like an old person"),
)
_STYLES = {
    "normal": (("",), ("",), ("normally", "in the usual way")),
    "happy": (
        ("happy", "cheerful"),
        ("who is happy", "who feels cheerful"),
        ("happily", "in a cheerful way"),
    ),
    "sad": (
        ("sad", "unhappy"),
        ("who is sad", "who feels unhappy"),
        ("sadly", "in an unhappy way"),
    ),
    "angry": (
        ("angry", "furious"),
        ("who is angry", "who feels furious"),
        ("angrily", "in a furious way"),
    ),
    "proud": (
        ("proud", "arrogant"),
        ("who is proud", "who looks arrogant"),
        ("proudly", "in an arrogant way"),
    ),
    "not-confident": (
        ("insecure", "timid"),
        ("who is not confident", "who feels insecure"),
        ("without confidence", "in a timid way"),
    ),
    "masculinity": _MASCULINE,
    "masculine": _MASCULINE,
    "feminine": (
        ("feminine", "womanly"),
        ("who is feminine", "who looks womanly"),
        ("in a feminine way", "in a womanly way"),
    ),
    "childish": (
        ("childish", "childlike"),
        ("who is childish", "who acts like a child"),
        ("in a childish way", "like a child"),
    ),
    "old": _OLD,
    "elderly": _OLD,
    "tired": (
        ("tired", "weary"),
        ("who is tired", "who feels weary"),
        ("wearily", "in a tired way"),
    ),
    "exhausted": (
        ("exhausted", "drained"),
        ("who is exhausted", "who feels drained"),
        ("in an exhausted way", "with no energy"),
    ),
    "active": (
        ("active", "energetic"),
        ("who is active", "who is full of energy"),
        ("in an active way", "energetically"),
    ),
    "musical": (
        ("musical", "rhythmic"),
        ("who is musical", "who feels the rhythm"),
        ("rhythmically", "as if to:ADP music"),
    ),
    "giant": (
        ("gigantic", "huge"),
        ("who is gigantic", "who is a huge giant"),
        ("like a giant", "with great weight"),
    ),
    "chimpira": (
        ("thuggish", "rowdy"),
        ("who is rowdy", "who acts like a thug"),
        ("like a thug", "in a rowdy way"),
    ),
    "youthful": (
        ("youthful", "young"),
        ("who is youthful", "who is very young"),
        ("in a youthful way", "like a young person"),
    ),
}


def _inflect(phrase: str, form: int) -> str:
    """The phrase with its verbs in the third person (1) or the -ing form (2)."""
    words = [_VERBS[w][form] if w in _VERBS else w for w in phrase.split()]
    return " ".join(words)


def _caption(sentence: str) -> tuple[str, str]:
    """Caption and tokens of a sentence; "a" becomes "an" before a vowel."""
    words, tokens = [], []
    marked = sentence.split()
    for item, following in zip(marked, [*marked[1:], ""], strict=True):
        word, _, pos = item.partition(":")
        # All words of the grammar are spoken as they are spelled, "youthful" too.
        if word == "a" and following.startswith(tuple("aeiou")):
            word = "an"
        words.append(word)
        tokens.append(f"{word}/{pos}" if pos else _TAGS[word])
    return " ".join(words), " ".join(tokens)


def _sentences(template: str, content: str, style: str) -> Iterator[str]:
    """All ways to fill a template."""
    adjectives, clauses, manners = _STYLES[style]
    finite, progressive = (
        [_inflect(phrase, form) for phrase in _CONTENTS[content]] for form in (1, 2)
    )
    if template == "clause":
        yield from (f"someone {c} {action}" for c in clauses for action in finite)
        return
    for noun in _PEOPLE:
        if template == "adjective":
            starts, middles, ends = adjectives, [f"{noun} {a}" for a in finite], ("",)
        elif template == "manner":
            starts, middles, ends = ("",), [f"{noun} {a}" for a in finite], manners
        else:
            middles = [f"{noun} is {action}" for action in progressive]
            starts, ends = ("",), manners
        yield from (f"a {s} {m} {e}" for s in starts for m in middles for e in ends)


def all_captions(
    content: str, style: str, *, templates: Sequence[str] = TEMPLATES
) -> tuple[tuple[str, str], ...]:
    """Every (sentence, tokens) of a content in a style, always in the same order.

    Labels such as "walk-turn-left" and "elderly" are of either set, templates of
    `TEMPLATES` (all but a held-out one, say). A `ValueError` lists the known ones.
    """
    known = {
        "content": (_CONTENTS, [content]),
        "style": (_STYLES, [style]),
        "template": (TEMPLATES, templates),
    }
    for what, (names, given) in known.items():
        for name in given:
            if name not in names:
                raise ValueError(
                    f"unknown {what} {name!r}: the grammar has {', '.join(names)}"
                )
    return tuple(
        dict.fromkeys(
            _caption(sentence)
            for template in templates
            for sentence in _sentences(template, content, style)
        )
    )


def captions_for(
    content: str,
    style: str,
    *,
    seed: int,
    index: int,
    count: int,
    templates: Sequence[str] = TEMPLATES,
) -> list[tuple[str, str]]:
    """Some (sentence, tokens) of a clip, drawn without repetition from all.

    The clip's index makes clips with the same labels differ; the same arguments give
    the same captions. Templates are of `TEMPLATES`.

    `ValueError` if a name is unknown, or there are fewer captions than that.
    """
    choices = all_captions(content, style, templates=templates)
    if not 0 < count <= len(choices):
        raise ValueError(
            f"content {content!r} in style {style!r} has {len(choices)} captions, "
            f"asked for {count}"
        )
    generator = np.random.default_rng([seed, index])
    chosen = generator.choice(len(choices), count, replace=False)
    return [choices[number] for number in chosen]
