import itertools
import re

import numpy as np
import pytest

from jaxmotion.data import captions
from jaxmotion.data.builders import bandai_namco

PAIRS = [
    pair
    for number in ("1", "2")
    for pair in itertools.product(
        bandai_namco._CONTENTS[number].split(), bandai_namco._STYLES[number].split()
    )
]
POS = {"DET", "PRON", "AUX", "ADP", "CCONJ", "SCONJ", "PART", "ADJ", "ADV", "NOUN"}
POS |= {"VERB", "NUM"}


def every():
    for content, style in PAIRS:
        yield from captions.all_captions(content, style)


def test_both_sets_are_covered_with_many_different_captions():
    assert len(PAIRS) == 17 * 15 + 10 * 7
    for content, style in PAIRS:
        found = captions.all_captions(content, style)
        assert len({text for text, _ in found}) == len(found) >= 20, (content, style)
        assert found == captions.all_captions(content, style)


def test_labels_of_one_set_share_no_caption():
    for number in ("1", "2"):
        contents = bandai_namco._CONTENTS[number].split()
        styles = bandai_namco._STYLES[number].split()
        owner = {}
        for pair in itertools.product(contents, styles):
            for text, _ in captions.all_captions(*pair):
                assert owner.setdefault(text, pair) == pair, text


@pytest.mark.parametrize(
    ("content", "style", "text", "tokens"),
    [
        (
            "walk-turn-left",
            "elderly",
            "an elderly person walks and turns left",
            "an/DET elderly/ADJ person/NOUN walk/VERB and/CCONJ turn/VERB left/ADV",
        ),
        (
            "wave-both-hands",
            "exhausted",
            "someone who is exhausted waves with both hands",
            "someone/PRON who/PRON is/AUX exhausted/ADJ wave/VERB with/ADP both/DET "
            "hand/NOUN",
        ),
        (
            "run",
            "feminine",
            "a person runs in a feminine way",
            "a/DET person/NOUN run/VERB in/ADP a/DET feminine/ADJ way/NOUN",
        ),
        (
            "punch",
            "old",
            "a figure is throwing a punch like an old person",
            "a/DET figure/NOUN is/AUX throw/VERB a/DET punch/NOUN like/ADP an/DET "
            "old/ADJ person/NOUN",
        ),
        (
            "raise-up-left-hand",
            "normal",
            "someone raises the left hand",
            "someone/PRON raise/VERB the/DET left/ADJ hand/NOUN",
        ),
        (
            "byebye",
            "normal",
            "a person is waving to say goodbye normally",
            "a/DET person/NOUN is/AUX wave/VERB to/PART say/VERB goodbye/NOUN "
            "normally/ADV",
        ),
    ],
)
def test_captions_and_tokens_read_as_they_should(content, style, text, tokens):
    assert (text, tokens) in captions.all_captions(content, style)


def test_articles_fit_the_next_word():
    found = set()
    for text, _ in every():
        found |= set(re.findall(r"\b(an? \w+)", text))
    vowels = {"active", "angry", "answer", "arrogant", "elderly", "energetic"}
    vowels |= {"exhausted", "insecure", "old", "unhappy"}
    assert {x for x in found if x.startswith("an ")} == {f"an {w}" for w in vowels}
    assert {"a youthful", "a huge", "a person"} <= found


def test_every_word_has_a_tag_and_nothing_else_occurs():
    for text, tokens in every():
        assert re.fullmatch(r"[a-z]+( [a-z]+)*", text), text
        pairs = [token.split("/") for token in tokens.split(" ")]
        assert len(pairs) == len(text.split(" ")) <= 20
        for word, (lemma, pos) in zip(text.split(" "), pairs, strict=True):
            assert pos in POS
            if pos not in ("VERB", "NOUN"):
                assert lemma == word
            assert lemma[:2] == word[:2] and len(lemma) <= len(word) + 1


def test_templates_can_be_left_out():
    rest = [name for name in captions.TEMPLATES if name != "clause"]
    seen = captions.all_captions("walk", "sad", templates=rest)
    unseen = captions.all_captions("walk", "sad", templates=["clause"])
    assert not set(seen) & set(unseen)
    assert set(seen) | set(unseen) == set(captions.all_captions("walk", "sad"))
    assert all(text.startswith("someone who") for text, _ in unseen)


def draw(index, seed=0, **options):
    return captions.captions_for(
        "run", "happy", seed=seed, index=index, count=4, **options
    )


def test_draws_repeat_and_clips_differ():
    assert draw(5) == draw(5)
    assert len(set(draw(5))) == 4
    assert draw(5) != draw(6) and draw(5) != draw(5, seed=1)
    drawn = [pair for index in range(400) for pair in draw(index)]
    choices = captions.all_captions("run", "happy")
    counts = np.array([drawn.count(pair) for pair in choices])
    assert counts.sum() == 1600  # nothing else is drawn
    p = 4 / len(choices)
    assert np.abs((counts - 400 * p) / np.sqrt(400 * p * (1 - p))).max() < 3.5
    clauses = draw(0, templates=["clause"])
    assert set(clauses) == set(
        captions.all_captions("run", "happy", templates=["clause"])
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"content": "swim"}, "unknown content 'swim': the grammar has walk, run"),
        ({"style": "bored"}, "unknown style 'bored': the grammar has normal"),
        ({"templates": ["poem"]}, "unknown template 'poem'.*adjective, clause"),
        ({"count": 99}, "content 'walk' in style 'sad' has 28 captions, asked for 99"),
        ({"count": 0}, "asked for 0"),
    ],
)
def test_what_is_unknown_is_named(change, message):
    given = {"content": "walk", "style": "sad", "count": 1, **change}
    with pytest.raises(ValueError, match=message):
        captions.captions_for(
            given.pop("content"), given.pop("style"), seed=0, index=0, **given
        )
