"""Read joint names: split them into words, translate the words, find the side, and leave out what all names have in common."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

__all__ = ["NOTHING", "JointName", "read_names"]


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


# Canonical word -> spellings. A spelling of several words, as `uarm`, is in `_COMPOUNDS`.
_BODY = {
    "pelvis": "pelvis 下半身", "hip": "hip hips", "torso": "torso", "spine": "spine chest abdomen abdo ab thorax waist ribcage"
    " rib belly stomach back 上半身 腰 胸", "root": "root 全ての親 センター", "body": "body", "neck": "neck 首",
    "head": "head skull 頭", "jaw": "jaw あご 顎", "eye": "eye eyeball 目",
    "thigh": "thigh femur", "leg": "leg 足 脚", "knee": "knee ひざ 膝", "shin": "shin calf tibia shank すね",
    "ankle": "ankle talus 足首", "foot": "foot feet", "toe": "toe toes つま先 爪先 足先", "ball": "ball",
    "collar": "collar clavicle clav collarbone 鎖骨", "scapula": "scapula scap", "shoulder": "shoulder shldr 肩",
    "arm": "arm 腕", "humerus": "humerus", "elbow": "elbow ひじ 肘", "radius": "radius", "ulna": "ulna", "wrist": "wrist 手首",
    "hand": "hand palm 手", "finger": "finger fingers 指", "thumb": "thumb 親指", "index": "index 人指 人差指 人差し指",
    "middle": "middle mid 中指", "ring": "ring 薬指", "pinky": "pinky pinkie little 小指",
    "upper": "upper up upr", "lower": "lower low lo lwr", "fore": "fore",
    "front": "front", "rear": "rear hind", "big": "big", "small": "small",
    "base": "base",
}  # fmt: skip
_COMPOUNDS = {
    "uarm": ("upper", "arm"), "farm": ("fore", "arm"), "uleg": ("upper", "leg"), "proximal": ("1",), "intermediate": ("2",),
    "distal": ("3",),
}  # fmt: skip
_SIDES = {
    **dict.fromkeys(_words("l lf lt lft left 左"), "l"),
    **dict.fromkeys(_words("r rt rgt right 右"), "r"),
}
_ALONE = _words("lf lt rt c m x b j f")  # never part of a longer word: `lfarm` is the left forearm
# Words that say nothing about the part: names of programs, `joint`, and letters for the middle of the body.
_FILLERS = _words(
    "mixamorig bip biped valve character cc j b bn f bone joint jnt jt bind skin skel skeleton sk rig armature c m x"
    " center centre mesh smpl smplh smplhf smplx def"
)
# Words of joints beside the bone of the same name, with the cost of taking such a joint for it all the same.
_ASIDE = {"bend": 0.5, "stretch": 0.5, "org": 0.5, "fk": 2.0, **dict.fromkeys(_words("twist roll part share 捩 捩り"), 4.0)}
# Words of joints that are no part of the body although their names may say so: controls, tips, clothes, things carried.
_OTHERS = _words(
    "ik pole target tgt ctrl ctr ctl control controller con effector eff goal handle end nub tip top site mch parent tweak proc"
    " socket weapon gun sword shield prop item camera cam marker locator loc null grp group offset pivot hair skirt cloth cape"
    " sleeve tail wing fin ear horn antenna breast bust boob pec butt buttock glute nail tongue lip cheek brow lid eyelid nose"
    " tooth teeth chin jiggle phys physics sec proxy dummy ダミー 親 キャンセル attach holder volume muscle corrective corr"
    " driver drv aim look metacarpal metacarpals heel slide adj helper help aux"
)
_LEXICON: dict[str, tuple[str, ...]] = {
    **{word: (word,) for word in {*_FILLERS, *_ASIDE, *_OTHERS, *_SIDES}},
    **{spelling: (word,) for word, spellings in _BODY.items() for spelling in spellings.split()},
    **_COMPOUNDS,
}
_LONGEST = max(map(len, _LEXICON))
_PIECE = re.compile(r"[^\W\d_]+|\d+")
_CAMEL = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[^A-Za-z]+")
_REMARK = re.compile(r"\[[^\]]*\]|\([^)]*\)")  # as in Skyrim's `NPC L Thigh [LThg]`
_DEFORMING = re.compile("DEF[-_]")  # Rigify's bones that move the mesh, beside ORG-, MCH- and controls
# A word, or the letters at the start, in so many of the names belong to all of them.
_COMMON = 0.75
_MIN_NAMES = 5
_MAX_LETTERS = 100
# Beside the name of a part, that of the larger part says nothing: `foot_ankle`, `LLeg_Calf`, `hand_index1`, `head_eye`.
_WITHIN = {
    "leg": {"thigh", "knee", "shin", "ankle", "foot", "toe", "ball"}, "foot": {"ankle", "toe", "ball"},
    "arm": {"collar", "scapula", "shoulder", "humerus", "elbow", "radius", "ulna", "wrist", "hand"},
    "hand": {"wrist", "finger", "thumb", "index", "middle", "ring", "pinky"},
    "finger": {"thumb", "index", "middle", "ring", "pinky"}, "head": {"eye", "jaw"}, "spine": {"neck"},
}  # fmt: skip


@dataclass(frozen=True)
class JointName:
    """What the name of a joint says."""

    side: str
    """`l`, `r`, or empty."""
    words: frozenset[str]
    """Parts of the body and words such as `upper`, in English."""
    numbers: tuple[int, ...]
    """Numbers in the name that not all names have."""
    doubt: float
    """0 if every word is understood; grows with unknown words and with those of auxiliary joints; infinite for other things."""
    is_deforming: bool = False
    """Whether the name says that the joint is a bone that moves the mesh, in a rig that has other bones as well."""


NOTHING = JointName("", frozenset(), (), float("inf"))
"""A name that says nothing."""


def read_names(names: Sequence[str]) -> list[JointName]:
    """Return what each of the joint names says; letters and words that most of them have in common are left out."""
    plain = [_REMARK.sub(" ", re.split(r"[:|]", unicodedata.normalize("NFKC", name[-_MAX_LETTERS:]))[-1]) for name in names]
    start = _common_start(plain)
    split = [_split(name.removeprefix(start) or name) for name in plain]
    counts = Counter(word for words in split for word in set(words))
    common = {word for word, count in counts.items() if len(names) >= _MIN_NAMES and count >= _COMMON * len(names)}
    read = [_understood([word for word in words if word not in common]) for words in split]
    return [replace(name, is_deforming=bool(_DEFORMING.match(full))) for name, full in zip(read, plain, strict=True)]


def _common_start(names: Sequence[str]) -> str:
    """Return the longest start of three quarters of the names."""
    start, rest = "", list(names)
    while len(names) >= _MIN_NAMES:
        letters = Counter(name[len(start)] for name in rest if len(name) > len(start))
        letter, count = max(letters.items(), key=lambda item: item[1], default=("", 0))
        if count < _COMMON * len(names):
            break
        start += letter
        rest = [name for name in rest if name.startswith(start)]
    return start


def _split(name: str) -> list[str]:
    """Return the canonical words and the numbers of a name; unknown words in lower case."""
    words: list[str] = []
    for piece in _PIECE.findall(name):
        if piece.isdecimal():
            words.append(str(int(piece[:9])))
            continue
        whole = _known_words(piece.lower())
        if whole is None:
            for part in _CAMEL.findall(piece):
                words += _known_words(part.lower()) or (part.lower(),)
        else:
            words += whole
    return words


@lru_cache(maxsize=4096)
def _known_words(text: str) -> tuple[str, ...] | None:
    """Return the fewest known words that make up a text, in canonical form; None if there are none.

    Single letters count as words only for the side, at either end.
    """
    if text in _LEXICON:
        return _LEXICON[text]
    best: dict[int, tuple[int, tuple[str, ...]]] = {0: (0, ())}  # by end: number of words, and their canonical forms
    for end in range(1, len(text) + 1):
        for begin in range(max(end - _LONGEST, 0), end):
            word = text[begin:end]
            is_inside = word in ("l", "r") and begin > 0 and end < len(text)
            if begin not in best or word not in _LEXICON or word in _ALONE or is_inside:
                continue
            count, words = best[begin]
            if end not in best or count + 1 < best[end][0]:
                best[end] = count + 1, words + _LEXICON[word]
    return best[len(text)][1] if len(text) in best else None


def _understood(words: list[str]) -> JointName:
    sides = [word for word in words if word in _SIDES]
    side = max(sides, key=len, default="")  # `left` is clearer than a letter
    body: set[str] = set()
    numbers, doubt = [], 0.0
    for word in words:
        if word.isdecimal():
            numbers.append(int(word))
        elif word in _BODY:
            body.add(word)
        elif word in _OTHERS:
            doubt = float("inf")
        elif word in _ASIDE:
            doubt += _ASIDE[word]
        elif word not in _FILLERS and word not in _SIDES:
            doubt += 1.0
    body -= {"body"} if not body & {"upper", "lower"} else set()
    body -= {"base"} if "toe" not in body else set()
    context = {word for word, smaller in _WITHIN.items() if body & smaller}
    doubt += 0.1 * len(body & context & {"arm", "leg"})
    return JointName(_SIDES.get(side, ""), frozenset(body - context), tuple(numbers), doubt)
