"""Map the joints of a skeleton to the joints of a file that move them."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError, nearest
from snarfcli.files import read_json
from snarfcli.formats.rig import Rig
from snarfcli.motions.humanoid import humanoid_parts
from snarfcli.motions.joint_names import REQUIRED_PARTS, BodyParts, find_body_parts, spine_between
from snarfcli.motions.plain_names import plain_name
from snarfcli.motions.tree_shape import find_by_shape

__all__ = ["map_joints"]

log = logging.getLogger(__name__)

_SHAPED = (*REQUIRED_PARTS, "l_ankle", "r_ankle", "l_wrist", "r_wrist")  # parts in which names and shape have to agree
_MAX_LETTERS = 280  # of the names in a message


def map_joints(
    skeleton: Skeleton, rig: Rig, path: Path, mapping: str | Path | Mapping[str, str | None] | None = None
) -> dict[int, int]:
    """Return the index of the rig's joint that moves each joint of the skeleton; joints without one are left out.

    If the rig has every name of the skeleton, joints are paired by name. Otherwise they are paired as parts of a human body,
    which a VRM file names itself, the joints of the spine from both ends, and the remaining joints by name. Parts that names do
    not tell are taken from the shape of the tree if that is clearly a person. `mapping` overrides all this.

    Args:
        skeleton: the target.
        rig: the source.
        path: file of the rig, for messages.
        mapping: {joint of the skeleton: joint of the file, or None to keep it at rest}, or the path of such a JSON file.

    Raises:
        UserError: too few joints are recognised, or the mapping names a joint that does not exist.
    """
    exact = {name: joint for joint, name in enumerate(rig.names)}
    sources = _Names(rig.names)
    pairs: dict[int, int] = {}
    if all(name in exact for name in skeleton.names):
        pairs = {joint: exact[name] for joint, name in enumerate(skeleton.names)}
    else:
        target = find_body_parts(skeleton.names, skeleton.parents)
        source = humanoid_parts(rig) or find_body_parts(rig.names, rig.parents)
        if mapping is None and source.missing and not target.missing:
            source = _with_shape(source, rig, path)
        pairs = _pair_parts(target, source)
        for joint, name in enumerate(skeleton.names):
            number = sources.find(name)
            if joint not in pairs and number is not None and number not in pairs.values():
                pairs[joint] = number
        if mapping is None:
            _check_pairs(pairs, target, source, skeleton, rig, path)
    if mapping is not None:
        _overrule(pairs, mapping, skeleton, rig, path)
    if 0 not in pairs:
        pairs[0] = 0
    return dict(sorted(pairs.items()))


def _check_pairs(pairs: dict[int, int], target: BodyParts, source: BodyParts, skeleton: Skeleton, rig: Rig, path: Path) -> None:
    """Raise UserError if required parts of a human body, or half the joints of another skeleton, have no counterpart."""
    missing = [part for part in REQUIRED_PARTS if part in target.joints and part not in source.joints]
    is_human = all(part in target.joints for part in REQUIRED_PARTS)
    if missing:
        what = f"no joint for {', '.join(missing)}"
    elif not is_human and 2 * len(pairs) < skeleton.num_joints:
        what = f"joints for only {len(pairs)} of {skeleton.num_joints}"
    else:
        return
    raise UserError(
        f'{path} has {what}; give mapping=FILE.json with {{"joint of the skeleton": "joint of the file", ...}};'
        f" the skeleton has {_listed(skeleton.names)}; the file has {_listed(rig.names)}"
    )


def _with_shape(named: BodyParts, rig: Rig, path: Path) -> BodyParts:
    """Add the parts that the shape of the rig tells; names that are known decide on left and right.

    Nothing is added if the shape is not clearly that of a person, contradicts the names, or does not tell left from right.
    """
    inner = set(rig.parents)
    tips = {joint for joint, name in enumerate(rig.names) if joint not in inner and name.lower().endswith("_end")}
    shape = find_by_shape(rig.parents, rig.rest[:, :3, 3], tips)
    if shape is None:
        return named
    parts = [shape.joints, {_other_side(part): joint for part, joint in shape.joints.items()}]
    fits = [all(each.get(part, joint) == joint for part, joint in named.joints.items() if part in _SHAPED) for each in parts]
    if not any(fits) or (all(fits) and not shape.has_sides):
        return named
    joints = parts[fits.index(True)] | named.joints
    guessed = [part for part in joints if part not in named.joints]
    sides = "; left and right are guessed from the feet" if all(fits) else ""
    log.info(
        "%s: the shape of the tree gives joints that have no known names (%s)%s; mapping=FILE.json says otherwise",
        path.name,
        _listed([f"{part}: {rig.names[joints[part]]}" for part in guessed]),
        sides,
    )
    return BodyParts(joints, spine_between(joints, rig.parents))


def _other_side(part: str) -> str:
    return {"l_": "r_", "r_": "l_"}.get(part[:2], part[:2]) + part[2:]


class _Names:
    """Joint indices by exact name, or by common spelling if that is unique."""

    def __init__(self, names: Sequence[str]) -> None:
        self.exact = {name: joint for joint, name in enumerate(names)}
        plain = [plain_name(name) for name in names]
        counts = Counter(plain)
        self.plain = {name: joint for joint, name in enumerate(plain) if name and counts[name] == 1}

    def find(self, name: str) -> int | None:
        return self.exact.get(name, self.plain.get(plain_name(name)))


def _pair_parts(target: BodyParts, source: BodyParts) -> dict[int, int]:
    pairs = {joint: source.joints[part] for part, joint in target.joints.items() if part in source.joints}
    few, many = sorted((target.spine, source.spine), key=len)
    # The ends of the spine carry hips and shoulders; the joints between are paired evenly.
    last = len(many) - 1
    picks = [round(number * last / (len(few) - 1)) for number in range(len(few))] if len(few) > 1 else [0] * len(few)
    for number, pick in enumerate(picks):
        at, of = (number, pick) if few is target.spine else (pick, number)
        pairs[target.spine[at]] = source.spine[of]
    return pairs


def _overrule(
    pairs: dict[int, int], mapping: str | Path | Mapping[str, str | None], skeleton: Skeleton, rig: Rig, path: Path
) -> None:
    """Replace pairs by those of the user's mapping."""
    where, content = "mapping", mapping
    if isinstance(mapping, (str, Path)):
        where, content = f"mapping {mapping}", read_json(mapping, "mapping")
    is_good = isinstance(content, Mapping) and all(
        isinstance(key, str) and (value is None or isinstance(value, str)) for key, value in content.items()
    )
    if not isinstance(content, Mapping) or not is_good:
        raise UserError(f'{where}: wanted {{"joint of the skeleton": "joint of the file" or null, ...}}, got something else')
    targets, sources = _Names(skeleton.names), _Names(rig.names)
    for target_name, source_name in content.items():
        target = targets.find(target_name)
        if target is None:
            raise UserError(
                f"{where}: the skeleton has no joint {target_name!r:.60}{nearest(target_name, skeleton.names) or '.'}"
                f" It has {_listed(skeleton.names)}"
            )
        if source_name is None:
            pairs.pop(target, None)
            continue
        source = sources.find(source_name)
        if source is None:
            raise UserError(
                f"{where}: {path} has no joint {source_name!r:.60}{nearest(source_name, rig.names) or '.'}"
                f" It has {_listed(rig.names)}"
            )
        pairs[target] = source


def _listed(names: Sequence[str]) -> str:
    """Return names for a message, printable and at most about `_MAX_LETTERS` letters."""
    shown: list[str] = []
    for name in names:
        name = name[:40] if name.isprintable() else ascii(name[:40])[1:-1]
        if sum(map(len, shown)) + len(name) > _MAX_LETTERS:
            return ", ".join(shown) + f" and {len(names) - len(shown)} more"
        shown.append(name)
    return ", ".join(shown)
