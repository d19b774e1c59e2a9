"""The systems of the papers: what each does with a point, and what all of them have in common."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import nn
from torch.nn import functional as F
from toy_training import avatar_config, toy_store, training_config

from snarfcli.avatar import Avatar
from snarfcli.datasets.stick2d import stick_subject
from snarfcli.deformer import CanonicalGrid, SearchConfig
from snarfcli.deformer.skinning import skin
from snarfcli.draws import GeneratorDraws
from snarfcli.errors import UserError
from snarfcli.models.nasa import PartNetworks
from snarfcli.models.pointwise import invert_blended
from snarfcli.models.settings import ModelConfig
from snarfcli.models.smpl_nn import nearest_vertex
from snarfcli.models.trained_field import SYSTEMS
from snarfcli.shape import ConditionConfig
from snarfcli.training.rough_shape import rough_canonical_points
from snarfcli.training.trainer import Trainer

CPU = torch.device("cpu")
POSES = torch.tensor([[[0.0, 0.0, 0.3], [0.0, 0.0, 0.9]], [[0.0, 0.4, 0.0], [0.2, 0.0, -0.7]]])


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return toy_store(tmp_path_factory.mktemp("data"), points=400, frames=12)


def template_of(store) -> SimpleNamespace:
    """Return the subject's mesh as tensors."""
    return SimpleNamespace(vertices=torch.tensor(store.template.vertices), weights=torch.tensor(store.template.weights).float())


def new_system(store, name: str, *, condition: str = "global", as_it_starts: bool = False, **changes) -> Avatar:
    """Return an untrained avatar of one system; with its weights disturbed, unless it is wanted `as_it_starts`."""
    config = avatar_config(capsules=True, condition=condition)
    config = replace(config, model=ModelConfig(name, **changes))
    if name == "snarf":
        config = replace(config, search=SearchConfig("broyden", max_steps=20))
    surface = rough_canonical_points(store)
    grid = CanonicalGrid.around(surface, config.skinning.margin_m)
    torch.manual_seed(0)
    avatar = Avatar(config, store.skeleton, grid, surface, {}, template=store.template)
    with torch.no_grad():
        for parameter in () if as_it_starts else avatar.model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return avatar.to("cpu")


def points_near(avatar: Avatar, transforms: torch.Tensor, count: int = 300) -> torch.Tensor:
    """Return points [B, count, 3] in the posed boxes."""
    generator = torch.Generator().manual_seed(1)
    boxes = [avatar.posed_box(one) for one in transforms]
    return torch.stack([lower + torch.rand(count, 3, generator=generator) * (upper - lower) for lower, upper in boxes])


@pytest.mark.parametrize("name", SYSTEMS)
def test_where_a_body_stands_changes_nothing(store, name):
    """The field moves with the body, through the root's global orientation too."""
    avatar = new_system(store, name)
    transforms = avatar.bone_transforms(POSES)
    points = points_near(avatar, transforms)
    moved = torch.eye(4)
    moved[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0.0, -1.1, 0.4], [1.1, 0, -0.2], [-0.4, 0.2, 0]]))
    moved[:3, 3] = torch.tensor([0.3, -0.2, 0.5])
    here = avatar.query(points, transforms, POSES)
    there = avatar.query(points @ moved[:3, :3].T + moved[:3, 3], moved @ transforms, POSES)
    spread = float(here.logits.std())
    same = (here.logits - there.logits).abs() < 0.02 * spread
    # a point on a cell's face, or on the border between two vertices' regions, may fall to either side
    assert float(same.float().mean()) > 0.98
    assert spread > 1e-3


@pytest.mark.parametrize("name", SYSTEMS)
def test_files_keep_the_field(store, name, tmp_path):
    avatar = new_system(store, name)
    avatar.save(tmp_path / "avatar.pt")
    again = Avatar.load(tmp_path / "avatar.pt")
    transforms = avatar.bone_transforms(POSES)
    points = points_near(avatar, transforms)
    assert torch.equal(again.query(points, transforms, POSES).logits, avatar.query(points, transforms, POSES).logits)
    for mine, theirs in zip(avatar.posed_box(transforms[0]), again.posed_box(transforms[0]), strict=True):
        assert torch.equal(mine, theirs)


@pytest.mark.parametrize("name", SYSTEMS)
def test_training_lowers_the_loss_and_reaches_every_weight(store, name):
    avatar = new_system(store, name, as_it_starts=True)
    trainer = Trainer(avatar, store, training_config(steps=40, bootstrap_steps=40), 0, CPU)
    before = [p.detach().clone() for p in trainer.optimizer.parameters]
    numbers = [trainer.advance() for _ in range(40)]
    first, last = (sum(n["occupancy"] for n in part) / 5 for part in (numbers[:5], numbers[-5:]))
    assert last < 0.9 * first
    assert all(bool((p != old).any()) for p, old in zip(trainer.optimizer.parameters, before, strict=True) if p.numel())
    assert ("parts" in numbers[0]) == (name in ("nasa", "piecewise"))
    assert ("joint_weight" in numbers[0]) == (name in ("fast_snarf", "snarf", "back_lbs"))


def test_blended_transforms_are_inverted():
    generator = torch.Generator().manual_seed(0)
    canonical = torch.rand(2, 50, 3, generator=generator, dtype=torch.float64)
    weights = torch.softmax(torch.randn(2, 50, 4, generator=generator, dtype=torch.float64), -1)
    turns = 0.6 * torch.randn(2, 4, 3, generator=generator, dtype=torch.float64)
    zeros = torch.zeros_like(turns[..., 0])
    x, y, z = turns.unbind(-1)
    generators = torch.stack([zeros, -z, y, z, zeros, -x, -y, x, zeros], -1).unflatten(-1, (3, 3))
    transforms = torch.eye(4, dtype=torch.float64).repeat(2, 4, 1, 1)
    transforms[..., :3, :3] = torch.linalg.matrix_exp(generators)
    transforms[..., :3, 3] = torch.randn(2, 4, 3, generator=generator, dtype=torch.float64)
    posed = torch.stack([skin(*one) for one in zip(canonical, weights, transforms, strict=True)])
    torch.testing.assert_close(invert_blended(posed, weights, transforms), canonical, atol=1e-9, rtol=0)
    inputs = [posed[:, :3].clone().requires_grad_(), weights[:, :3].clone().requires_grad_()]
    assert torch.autograd.gradcheck(lambda p, w: invert_blended(p, w, transforms), inputs)


def test_opposite_rotations_send_points_away_and_nowhere_else():
    turned = torch.eye(4).repeat(1, 2, 1, 1)
    turned[0, 1, :2, :2] *= -1  # by half a turn about z
    out = invert_blended(torch.tensor([[[0.3, 0.2, 0.1]]]), torch.tensor([[[0.5, 0.5]]]), turned)
    assert bool(out.isfinite().all())


def test_smpl_nn_takes_the_vertices_of_the_base_mesh_home(store):
    avatar = new_system(store, "smpl_nn")
    template = template_of(store)
    transforms = avatar.bone_transforms(POSES)
    posed = torch.stack([skin(template.vertices, template.weights, one) for one in transforms])
    canonical, weights = avatar.model.canonical_points(posed, transforms, POSES)
    torch.testing.assert_close(canonical, template.vertices.expand_as(canonical), atol=1e-5, rtol=0)
    assert torch.equal(weights, template.weights.expand_as(weights))
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(nearest_vertex(points, posed[0]), torch.cdist(points.double(), posed[0].double()).argmin(1))


def test_back_lbs_starts_from_the_distances_to_the_posed_bones(store):
    avatar = new_system(store, "back_lbs")
    with torch.no_grad():
        avatar.model.weight_network.layers[-1].weight.zero_()
        avatar.model.weight_network.layers[-1].bias.zero_()
    transforms = avatar.bone_transforms(POSES)
    joints = avatar.skeleton.canonical_joints
    posed = torch.einsum("bjrc,jc->bjr", transforms[:, :, :3, :3], joints) + transforms[:, :, :3, 3]
    points = points_near(avatar, transforms, 100)
    # the first joint moves the segment to the second; the second, a last one, the continuation of this segment
    beyond = transforms[:, 1:, :3, :3] @ (2 * joints[1] - joints[0]) + transforms[:, 1:, :3, 3]
    distances = []
    for start, end in ((posed[:, :1], posed[:, 1:]), (posed[:, 1:], beyond)):
        along = end - start
        share = (((points - start) * along).sum(-1) / (along * along).sum(-1)).clamp(0, 1)[..., None]
        distances.append((points - start - share * along).norm(dim=-1))
    distances = torch.stack(distances, -1)
    wanted = torch.softmax(-distances / avatar.config.skinning.prior_falloff_m, -1)
    torch.testing.assert_close(avatar.model.posed_weights(points, transforms, POSES), wanted, atol=1e-4, rtol=0)


def test_parts_are_as_many_networks_of_their_own():
    torch.manual_seed(0)
    parts = PartNetworks(ModelConfig("nasa", part_width=8, part_depth=2, part_code=2), 3)
    local, roots = torch.randn(2, 3, 7, 3), torch.randn(2, 3, 3)
    out = parts(local, roots)
    for part in range(3):
        layers = []
        for weight, bias in zip(parts.weights, parts.biases, strict=True):
            layer = nn.Linear(*weight.shape[1:])
            layer.weight.data, layer.bias.data = weight[part].T, bias[part, 0]
            layers += [layer, nn.LeakyReLU(0.1)]
        network = nn.Sequential(*layers[:-1])
        for pose in range(2):
            code = roots[pose].reshape(-1) @ parts.reduce[part]
            inputs = torch.cat([local[pose, part], code.expand(7, -1)], 1)
            torch.testing.assert_close(out[pose, part], network(inputs)[:, 0], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("name", "deforms"), [("nasa", True), ("piecewise", False)])
def test_a_part_moves_with_its_bone_and_deforms_or_not(store, name, deforms):
    avatar = new_system(store, name, part_code=4)
    transforms = avatar.bone_transforms(POSES)
    canonical = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    moved = torch.einsum("brc,nc->bnr", transforms[:, 1, :3, :3], canonical) + transforms[:, 1, None, :3, 3]
    first, second = avatar.model.part_logits(moved, transforms)[:, 1].detach()
    assert torch.allclose(first, second, atol=1e-4) != deforms
    union = avatar.query(moved, transforms, POSES).logits
    torch.testing.assert_close(union, avatar.model.part_logits(moved, transforms).amax(1).detach())


def test_parts_start_as_capsules_around_their_bones(store):
    avatar = new_system(store, "nasa", as_it_starts=True)
    transforms = avatar.bone_transforms(POSES)
    points = points_near(avatar, transforms, 100)
    with torch.no_grad():
        with_capsules = avatar.model.part_logits(points, transforms)
        avatar.config.shape.prior_radius_m = None
        capsules = with_capsules - avatar.model.part_logits(points, transforms)
    joints = avatar.skeleton.canonical_joints
    posed = torch.einsum("bjrc,jc->bjr", transforms[:, :, :3, :3], joints) + transforms[:, :, :3, 3]
    along = (posed[:, 1] - posed[:, 0])[:, None]  # the first part has the bone, the last one the point where it ends
    share = (((points - posed[:, :1]) * along).sum(-1) / (along * along).sum(-1)).clamp(0, 1)[..., None]
    distances = torch.stack([(points - posed[:, :1] - share * along).norm(dim=-1), (points - posed[:, 1:]).norm(dim=-1)], 1)
    torch.testing.assert_close(capsules, 30.0 * (0.07 - distances), atol=1e-3, rtol=0)


def test_surface_points_belong_to_one_part(store):
    avatar = new_system(store, "nasa", part_weight=2.0, part_points=64)
    template, draws = template_of(store), GeneratorDraws.seeded(3)
    transforms = avatar.bone_transforms(POSES)
    loss = avatar.model.extra_losses(transforms, POSES, draws)["parts"]
    chosen = torch.randint(len(template.vertices), (64,), generator=torch.Generator().manual_seed(3))
    wanted = 0.0
    for one in transforms:
        posed = skin(template.vertices[chosen], template.weights[chosen], one)
        occupancy = avatar.model.part_logits(posed[None], one[None])[0].sigmoid().T  # [N, J]
        wanted += F.mse_loss(occupancy, 0.5 * F.one_hot(template.weights[chosen].argmax(1), 2).float()) / len(transforms)
    torch.testing.assert_close(loss, 2.0 * wanted)


def test_surface_points_of_a_planar_subject_are_on_its_outline():
    """The top and the bottom of its prism are above and below the inside: a part is full there, not on its border."""
    stick = stick_subject("stick")
    config = replace(avatar_config(capsules=True), model=ModelConfig("nasa", part_points=4096))
    surface = torch.tensor(stick.template.vertices, dtype=torch.float32)
    grid = CanonicalGrid.around(surface, config.skinning.margin_m)
    avatar = Avatar(config, stick.skeleton.to(torch.float32), grid, surface, {}, template=stick.template)
    seen = []
    avatar.model.part_logits = lambda points, *_: seen.append(points) or torch.zeros(1, avatar.model.num_bones, points.shape[1])
    transforms = avatar.bone_transforms(torch.zeros(1, stick.skeleton.num_joints, 3))
    avatar.model.extra_losses(transforms, torch.zeros(1, 4, 3), GeneratorDraws.seeded(0))
    beyond = seen[0][0, :, :2].abs() - torch.tensor([0.15, 0.8])  # the outline of the strip, metres
    torch.testing.assert_close(beyond.amax(1), torch.zeros(4096), atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", ["pose_onet", "back_d", "nasa"])
def test_local_condition_needs_skinning_weights(store, name):
    with pytest.raises(ValueError, match=f"model {name} has no skinning weights for condition=local"):
        new_system(store, name, condition="local")


def test_the_condition_may_say_where_it_enters(store):
    """They replace the settings of the shape, which stay the default."""
    config = avatar_config()
    grid = CanonicalGrid(torch.full((3,), -1.0), torch.full((3,), 1.0))
    for condition, layer, size in ((ConditionConfig("local"), 2, 4), (ConditionConfig("local", 1, 7), 1, 7)):
        shape = Avatar(replace(config, condition=condition), store.skeleton, grid).model.shape
        assert shape.config.condition_layer == layer
        assert shape.pose_code.out_features == size
        assert shape.layers[layer].in_features == 32 + size


@pytest.mark.parametrize("name", ["back_lbs", "smpl_nn", "snarf"])
def test_local_condition_shows_each_point_the_joints_that_move_it(store, name):
    avatar = new_system(store, name, condition="local")
    model, transforms = avatar.model, avatar.bone_transforms(POSES)
    model._joints_of_bones = torch.tensor([[0.0], [1.0]])  # of the two bones alone, each sees the joint between them
    with torch.no_grad():
        model.shape.pose_code.weight.mul_(30)  # so that it matters what a point sees
    if name == "snarf":
        found = model.deformer(points_near(avatar, transforms), transforms)
        canonical, pose, weights = found.canonical, found.pose, model.skinning_weights(found.canonical)
        logits = model.canonical_logits(canonical, model.condition(POSES), pose)
    else:
        points = points_near(avatar, transforms)
        canonical, weights = (part.flatten(0, 1) for part in model.canonical_points(points, transforms, POSES))
        pose = torch.arange(2).repeat_interleave(points.shape[1])
        logits = avatar.query(points, transforms, POSES).logits.flatten()
    wanted = model.shape(canonical, model.condition(POSES), pose, weights[:, 1:])
    torch.testing.assert_close(logits.detach(), wanted.detach(), atol=1e-4, rtol=1e-4)
    assert not torch.allclose(wanted, model.shape(canonical, model.condition(POSES), pose), atol=1e-2)


def test_the_weight_field_is_evaluated_once_per_step(store, monkeypatch):
    model = new_system(store, "fast_snarf", condition="local").model.train()
    transforms, calls = torch.eye(4).expand(2, 2, 4, 4), []
    field = model.deformer.field
    evaluate = field.at_fixed_points
    monkeypatch.setattr(field, "at_fixed_points", lambda *given, **named: calls.append(1) or evaluate(*given, **named))
    field.register_forward_hook(lambda *_: calls.append(1))
    found = model.find(torch.rand(2, 20, 3, generator=torch.Generator().manual_seed(0)), transforms, POSES)
    model.shape_at(found, POSES)
    points, owner = model.deformer.random_canonical(4, GeneratorDraws.seeded(0)), torch.tensor([0, 1, 0, 1])
    handed_on = model.bone_logits(points, owner, transforms, POSES, found=found)
    assert len(calls) == 1
    torch.testing.assert_close(handed_on, model.bone_logits(points, owner, transforms, POSES))


def test_points_of_bones_see_the_joints_of_their_bone(store):
    model = new_system(store, "back_lbs", condition="local").model
    model._joints_of_bones = torch.tensor([[0.0], [1.0]])
    points = torch.rand(1, 3, generator=torch.Generator().manual_seed(0)).expand(2, 3)  # one for each pose
    transforms = torch.eye(4).expand(2, 2, 4, 4)
    for owner, sees in ((0, False), (1, True)):
        first, second = model.bone_logits(points, torch.tensor([owner, owner]), transforms, POSES).tolist()
        assert (first != pytest.approx(second, abs=1e-5)) == sees


SPOILT_TEMPLATES = {
    "template.vertices: wanted shape .any, 3., got .3.": {"vertices": torch.zeros(3)},
    "template.vertices: wanted finite numbers": {"vertices": torch.full((4, 3), torch.nan)},
    "template.vertices: wanted dtype torch.float32, got torch.int32": {"vertices": torch.zeros(4, 3, dtype=torch.int32)},
    "template.weights: wanted shape .any, 2., got .4, 7.": {"weights": torch.zeros(4, 7)},
    "template.weights: wanted shape .any, 2., got str": {"weights": "ones"},
    "template: 4 vertices, but weights for 5": {"weights": torch.ones(5, 2)},
}


@pytest.mark.parametrize("problem", SPOILT_TEMPLATES)
def test_a_spoilt_template_in_a_file_is_rejected(store, problem):
    content = new_system(store, "smpl_nn").to_dict()
    content["template"] = {"vertices": torch.zeros(4, 3), "weights": torch.ones(4, 2)}
    Avatar.from_dict(content)
    content["template"] |= SPOILT_TEMPLATES[problem]
    with pytest.raises(UserError, match=f"does not describe an avatar of this version .{problem}"):
        Avatar.from_dict(content)
    content["template"] = None
    with pytest.raises(UserError, match="model smpl_nn needs a template, got NoneType"):
        Avatar.from_dict(content)


def test_gradients_reach_the_pose_through_the_base_mesh(store):
    avatar = new_system(store, "smpl_nn")
    transforms = avatar.bone_transforms(POSES).requires_grad_()
    avatar.model(torch.rand(2, 20, 3), transforms, POSES).logits.sum().backward()
    assert float(transforms.grad.abs().max()) > 0


def test_what_a_system_lacks_is_rejected(store):
    avatar = new_system(store, "nasa")
    with pytest.raises(ValueError, match="model nasa has no canonical shape"):
        avatar.mesh(POSES[0], resolution=16, surface="skinned")
    with pytest.raises(ValueError, match="search: wanted none, since model nasa searches no correspondences, got broyden"):
        avatar.model.choose_search(SearchConfig("broyden"))
    with pytest.raises(ValueError, match="model back_d has no skinning weights"):
        new_system(store, "back_d").skinning_weights(torch.zeros(1, 3))


@pytest.mark.parametrize("name", SYSTEMS)
def test_settings_of_the_quick_preset_suit_every_system(store, name):
    config = avatar_config(capsules=True)
    if name == "snarf":
        config = replace(config, search=SearchConfig("broyden", max_steps=20))
    config = replace(
        config,
        model=ModelConfig(name),
        skinning=replace(config.skinning, name="voxel", smoothness=1e-4),
        shape=replace(config.shape, name="grid", feature_cells_m=[0.2, 0.1]),
    )
    surface = rough_canonical_points(store)
    grid = CanonicalGrid.around(surface, config.skinning.margin_m)
    avatar = Avatar(config, store.skeleton, grid, surface, {}, template=store.template)
    training = training_config(steps=3, refresh_cells_every=2, extend_weights_every=2)
    trainer = Trainer(avatar, store, training, 0, CPU)
    numbers = [trainer.advance() for _ in range(3)]
    assert ("smoothness" in numbers[0]) == (name == "fast_snarf")
    again = Avatar.from_dict(trainer.finished_avatar().to_dict())
    assert again.config.model.name == name
