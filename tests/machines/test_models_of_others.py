"""MJCF files that anybody may have written: what they take in lies in their folder, what they ask for has limits."""

import os
import shutil
import sys
import time

import mujoco
import numpy as np
import pytest

from drive_env.pictures.scene import load_model
from mechanics.loads import LOADS, find_load
from mechanics.model import compile_packed, read_model
from mechanics.reading import limited_child
from mechanics.reading.untrusted import UntrustedFileError

BODY = '<body name="arm"><joint name="axle" axis="0 0 1"/><geom name="rod" size="0.1" mass="1" {of}/></body>'
MODEL = "<mujoco>{more}<worldbody>{inside}" + BODY + "</worldbody></mujoco>"
BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)


def write(folder, more="", inside="", of="", name="model.xml"):
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(MODEL.format(more=more, inside=inside, of=of))
    return folder / name


def mesh(path):
    """Write a box as an .obj."""
    path.parent.mkdir(exist_ok=True)
    path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in BOX) + "f 1 2 3\nf 2 3 4\nf 5 6 7\nf 1 5 8\n")


ASSET = '<asset><mesh name="box" file="{file}"/></asset>'
USED = 'type="mesh" mesh="box"'


# --- files ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "text",
    ['<include file="../elsewhere.xml"/>', "<INCLUDE\nfile='../elsewhere.xml'/>",
     '<include file="&#46;./elsewhere.xml"/>',
     '<include file="..\\elsewhere.xml"/>', '<a x="<!--"/><include file="../elsewhere.xml"/><a x="-->"/>',
     '<asset><model name="m" file="../elsewhere.xml"/></asset>', '<include file="{absolute}"/>',
     '<include file="within.xml"/>', '<include file="link.xml"/>'],
)  # fmt: skip
@pytest.mark.parametrize("read", [find_load, load_model])
def test_an_include_from_outside_the_model_s_folder_is_refused(text, read, tmp_path):
    """It was read, whatever it was."""
    (tmp_path / "elsewhere.xml").write_text("<mujoco/>")
    path = write(tmp_path / "mine", text.replace("{absolute}", str(tmp_path / "elsewhere.xml")))
    (tmp_path / "mine" / "within.xml").write_text('<mujoco><include file="../elsewhere.xml"/></mujoco>')
    (tmp_path / "mine" / "link.xml").symlink_to(tmp_path / "elsewhere.xml")
    with pytest.raises(
        UntrustedFileError, match=r"elsewhere\.xml.*, outside the model's folder .*copy it into"
    ) as told:
        read(path)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    "more",
    [ASSET.format(file="../meshes/box.obj"), '<compiler meshdir="../meshes"/>' + ASSET.format(file="box.obj"),
     '<compiler assetdir="../meshes"/>' + ASSET.format(file="box.obj"), ASSET.format(file="linked/box.obj")],
)  # fmt: skip
def test_a_mesh_from_outside_the_model_s_folder_is_refused_with_the_remedy(more, tmp_path):
    mesh(tmp_path / "meshes" / "box.obj")
    path = write(tmp_path / "mine", more, of=USED)
    (tmp_path / "mine" / "linked").symlink_to(tmp_path / "meshes")
    with pytest.raises(UntrustedFileError, match=r"box\.obj, outside .*move the model to a folder that holds both"):
        find_load(path)


@pytest.mark.every(5)
@pytest.mark.parametrize(
    "more",
    [ASSET.format(file="assets/box.obj"), '<compiler meshdir="assets"/>' + ASSET.format(file="box.obj"),
     '<compiler meshdir="./assets/"/>' + ASSET.format(file="../assets/box.obj"),
     '<include file="parts/assets.xml"/>',
     '<!-- <include file="../x.xml"/> -- a comment -->' + ASSET.format(file="box.obj")],
)  # fmt: skip
def test_files_in_the_model_s_folder_are_taken_in(more, tmp_path):
    for folder in ("", "assets", "parts"):
        mesh(tmp_path / "mine" / folder / "box.obj")
    (tmp_path / "mine" / "parts" / "assets.xml").write_text(
        "<mujoco>" + ASSET.format(file="assets/box.obj") + "</mujoco>"
    )
    path = write(tmp_path / "mine", more, of=USED)
    assert find_load(path).joints == ("axle",)
    assert load_model(path).nmesh == 1


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with a name here")
@pytest.mark.parametrize("more", ['<include file="pipe"/>', ASSET.format(file="pipe"), ""])
def test_a_pipe_is_refused_before_it_is_opened(more, tmp_path):
    """Nobody writes into it: MuJoCo waited without end."""
    path = write(tmp_path, more, of=USED if "mesh" in more else "")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UntrustedFileError, match="is a pipe or a device"):
        find_load(path if more else tmp_path / "pipe.xml" if (tmp_path / "pipe").rename(tmp_path / "pipe.xml") else "")


def test_a_missing_file_a_document_type_a_plug_in_are_refused(tmp_path):
    for more, told in (
        (ASSET.format(file="no.obj"), "takes in 'no.obj', and there is no such file"),
        ('<extension><plugin plugin="mujoco.elasticity.cable"/></extension>', "plug-in of MuJoCo"),
        ('<!DOCTYPE mujoco [<!ENTITY a "x">]>', "document type"),
        ("".join(ASSET.format(file=f"{k}.obj") for k in range(1001)), "more than 1000 files"),
    ):
        with pytest.raises(UntrustedFileError, match=told):
            find_load(write(tmp_path, more))


@pytest.mark.slow
def test_the_scan_for_files_takes_time_that_grows_as_the_text_does(tmp_path):
    """A million letters: milliseconds."""
    for more in ('<a "' * 250_000, "<!--" * 250_000, "<" * 10**6, "<a " + "b" * 10**6, "<a " + "b = " * 250_000):
        path = write(tmp_path, more)
        begun = time.process_time()
        with pytest.raises(ValueError):
            find_load(path)
        assert time.process_time() - begun < 20.0


# --- limits -----------------------------------------------------------------------------------------------------------
LARGE = {
    "height field": ('<asset><hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/></asset>',
                     '<geom type="hfield" hfield="h"/>', "memory"),
    "texture": ('<asset><texture name="t" type="2d" builtin="checker" width="60000" height="60000"/></asset>', "",
                "allocate memory"),
    "arena": ('<size memory="1000G"/>', "", "allocate memory"),
    "copies": ("", '<replicate count="1000000000" euler="0 0 1"><geom size="0.1"/></replicate>', "more than 1 s"),
}  # fmt: skip


@pytest.mark.every(4)
@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux alone")
@pytest.mark.parametrize("kind", LARGE)
def test_what_a_short_file_asks_for_has_limits(kind, tmp_path, monkeypatch):
    """6.4 GB of heights, 10.8 GB of a texture, 1 TB, 10^9 bodies: here another process ends, and this one goes on."""
    import resource

    monkeypatch.setattr(limited_child, "TIME", 1.0)
    more, inside, told = LARGE[kind]
    path = write(tmp_path, more, inside)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for read in (find_load, load_model):
        with pytest.raises(ValueError, match=told) as error:
            read(path)
        assert "\n" not in str(error.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB


# --- what is compiled elsewhere is what would be compiled here --------------------------------------------------------
@pytest.mark.every(4)
@pytest.mark.parametrize("copies", [None, 8])
@pytest.mark.parametrize("name", ["two_mass", "robot"])
def test_a_model_comes_back_as_it_was_compiled(name, copies, tmp_path):
    import dataclasses

    ours = LOADS[name]
    own = dataclasses.replace(ours, mjcf=tmp_path / ours.mjcf.name)
    shutil.copy(ours.mjcf, own.mjcf)
    here, there = (read_model(row) if copies is None else compile_packed(row, copies) for row in (ours, own))
    fields = [field for field in dir(here) if isinstance(getattr(here, field), np.ndarray)]
    assert len(fields) > 100
    for field in fields:
        assert np.array_equal(getattr(here, field), getattr(there, field), equal_nan=True), field
    assert here.names == there.names
    steps = []
    for model in (here, there):
        data = mujoco.MjData(model)
        data.qvel[:] = 1.0
        for _ in range(20):
            mujoco.mj_step(model, data)
        steps.append(data.qpos.copy())
    assert np.array_equal(*steps)


def test_a_model_that_has_changed_is_read_anew(tmp_path):
    (tmp_path / "more.xml").write_text('<mujoco><option gravity="0 0 -9.81"/></mujoco>')
    first = find_load(write(tmp_path, '<include file="more.xml"/>'))
    assert read_model(first).opt.gravity[2] == -9.81
    (tmp_path / "more.xml").write_text('<mujoco><option gravity="0 0 -1"/></mujoco>')
    assert read_model(first).opt.gravity[2] == -1.0


def test_whoever_changes_a_model_changes_his_own(tmp_path):
    for load in (find_load(write(tmp_path)), find_load("inertia")):
        before = float(read_model(load).opt.gravity[2])
        read_model(load).opt.gravity[2] = before + 5.0
        assert read_model(load).opt.gravity[2] == before


def test_models_of_ours_need_no_other_process(monkeypatch):
    monkeypatch.setattr("mechanics.model.call_limited", lambda *arguments: pytest.fail("a process was begun"))
    for row in LOADS.values():
        read_model(row)
    load_model(LOADS["two_mass"].mjcf)
