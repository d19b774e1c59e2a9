"""The avatar: the trained field of one subject, its surfaces, and its rigged character."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from typing_extensions import Self

from snarfcli.export.character import CharacterOptions
from snarfcli.export.clips import Clip
from snarfcli.export.export import ExportReport, export_character
from snarfcli.export.html import HtmlConfig, export_html
from snarfcli.export.joint_naming import named_joints
from snarfcli.export.model_card import model_card
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.posed import posed_mesh
from snarfcli.meshing.skinned import SkinnedSurface, skinned_surface
from snarfcli.models.hub import pretrained_folder
from snarfcli.models.pretrained import TENSORS_FILE, write_pretrained
from snarfcli.models.trained_field import TrainedField
from snarfcli.motions import Motion

__all__ = ["Avatar"]


class Avatar(TrainedField):
    """An animatable avatar of one subject."""

    def skinned_surface(self, resolution: int = 256, keep_share: float = 0.01) -> SkinnedSurface:
        """Return the surface that `mesh(surface="skinned")` poses, computed once; see `meshing.skinned_surface`."""
        return skinned_surface(self, resolution, keep_share)

    def mesh(self, pose: Tensor, translation: Tensor | None = None, *, resolution: int = 256, surface: str = "field") -> Mesh:
        """Return the posed mesh of one pose.

        Args:
            pose: [J, 3] or [1, J, 3] axis-angle, radians, global orientation included.
            translation: [3] or [1, 3], metres.
            resolution: voxels along the longest side.
            surface: "field" (the union of all correspondences, watertight) or "skinned" (the canonical mesh moved by
                linear blend skinning, with its weights; fast after the first call, always with the same faces).

        Raises:
            ValueError: `surface` is unknown, the system has no skinning weights, or the field has no surface in this pose.
        """
        pose = torch.as_tensor(pose).reshape(-1, 3)
        translation = None if translation is None else torch.as_tensor(translation).reshape(3)
        return posed_mesh(self, pose, translation, resolution, surface=surface)

    def export_glb(
        self,
        path: str | Path,
        motions: Motion | Clip | Sequence[Motion | Clip],
        *,
        triangles: int | None = 20000,
        influences: int = 4,
        morph_targets: int = 8,
        resolution: int = 256,
        weight_colors: bool = False,
        names: str | None = None,
        overwrite: bool = False,
    ) -> ExportReport:
        """Write a rigged, animated character as one `.glb` file, like `snarf export`. The file is whole or absent.

        Args:
            path: of the file.
            motions: one or more; each becomes a clip. A `Clip` has bone transforms for joints that stretch.
            triangles: maximum number of triangles; None keeps the extracted mesh.
            influences: maximum number of joints per vertex, 4 or 8.
            morph_targets: maximum number of morph targets for the pose-dependent shape; 0 for the mean shape.
            resolution: voxels along the longest side of the canonical box.
            weight_colors: whether vertices are coloured by their skinning weights.
            names: names of the joints of a human: "smpl", "mixamo", "vrm" or "unreal"; the skeleton's own by default.
            overwrite: whether an existing file is replaced.

        Returns:
            Facts about the file, and its deviation from `mesh(surface="skinned")`.

        Raises:
            ValueError: the system has no skinning weights, the field has no surface, or an argument is out of range.
        """
        clips = _clips(motions)
        options = CharacterOptions(triangles, influences, morph_targets, resolution, weight_colors)
        joint_names = named_joints(self.skeleton.names, self.skeleton.parents, names)
        return export_character(self, path, clips, options, joint_names=joint_names, overwrite=overwrite)

    def export_html(
        self,
        path: str | Path,
        motions: Motion | Clip | Sequence[Motion | Clip],
        *,
        triangles: int | None = 20000,
        morph_targets: int = 8,
        resolution: int = 256,
        title: str | None = None,
        license: str | None = None,
        overwrite: bool = False,
    ) -> ExportReport:
        """Write a page of at most 5 MB that plays the avatar offline, like `snarf export format=html`. It is whole or absent.

        Args:
            path: of the file.
            motions: one or more; each becomes a clip.
            triangles: maximum number of triangles; None for as many as fit.
            morph_targets: maximum number of morph targets for the pose-dependent shape; 0 for the mean shape.
            resolution: voxels along the longest side of the canonical box.
            title: of the page; the subject by default.
            license: a sentence; that of the data set by default.
            overwrite: whether an existing file is replaced.

        Returns:
            Facts about the file; fewer triangles or frames than wanted if these would not fit.

        Raises:
            ValueError: as `export_glb`, or the motions do not fit.
        """
        options = CharacterOptions(triangles, 4, morph_targets, resolution)
        return export_html(self, path, _clips(motions), options, HtmlConfig(title, license), overwrite=overwrite)[0]

    def save_pretrained(
        self, folder: str | Path, *, run: str | Path | None = None, license: str | None = None, overwrite: bool = False
    ) -> None:
        """Write a folder to be passed on: `model.safetensors`, `config.json`, and a model card `README.md`.

        Args:
            folder: created if it does not exist; other files in it stay.
            run: run folder whose results of `snarf eval` the card shows; by default that from which the avatar was loaded.
            license: a sentence; that of the data set by default.
            overwrite: whether files of these names are replaced.

        Raises:
            UserError: the folder is a file, or has such files.
            OSError: a file cannot be written.
        """
        place = Path(run) if run is not None else None if self.file is None else self.file.parent
        write_pretrained(folder, self.to_dict(), model_card(self, place, license), overwrite=overwrite)

    @classmethod
    def from_pretrained(cls, name: str | Path, device: str | torch.device = "cpu", *, revision: str | None = None) -> Self:
        """Return the avatar of a folder that `save_pretrained` wrote, ready to use on `device`.

        Args:
            name: a folder, or a repository `owner/name` or `hf://owner/name` of the Hugging Face Hub, which needs
                `pip install 'snarf[hub]'`. Only such a name leads to the network.
            device: device.
            revision: branch, tag or commit of the repository.

        Raises:
            UserError: the folder is missing, damaged, not that of an avatar, or of another format version; or the repository
                cannot be downloaded.
        """
        return cls.load(pretrained_folder(name, revision) / TENSORS_FILE, device)


def _clips(motions: Motion | Clip | Sequence[Motion | Clip]) -> list[Clip]:
    """Return motions and clips as clips."""
    several = [motions] if isinstance(motions, Motion | Clip) else motions
    return [motion if isinstance(motion, Clip) else Clip(motion) for motion in several]
