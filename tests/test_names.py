from __future__ import annotations

from snarfcli.names import folder_name, folder_names, unique_names


def test_a_name_that_is_taken_gets_the_first_free_number():
    assert unique_names(["walk", "run", "walk", "walk", "walk_2", "Walk"]) == [
        "walk",
        "run",
        "walk_2",
        "walk_3",
        "walk_2_2",
        "Walk",
    ]
    assert unique_names(["walk_2", "walk", "walk"]) == ["walk_2", "walk", "walk_3"]


def test_names_become_folders():
    assert folder_names(["Armature|Walk", "walk/2", "WALK_2", "..", "", "a" * 200]) == [
        "Armature_Walk", "walk_2", "WALK_2_2", "clip", "clip_2", "a" * 80,
    ]  # fmt: skip


def test_a_number_does_not_make_a_name_too_long():
    assert folder_names(["b" * 90, "b" * 90]) == ["b" * 80, "b" * 78 + "_2"]


def test_one_name_for_one_folder():
    assert folder_name("../a b") == "a_b"
    assert folder_name("a" * 79 + ".b") == "a" * 79
    assert folder_name("..", "motion") == "motion"
