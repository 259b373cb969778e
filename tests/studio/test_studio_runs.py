"""The folder of runs for web pages: what is listed, that nothing leads out of it, comparisons, learning curves."""

from __future__ import annotations

import json
import os

import pytest

pytest.importorskip("nicegui", reason="the extra `studio` is not installed")

from fastapi import FastAPI
from fastapi.testclient import TestClient
from rigs.trainings import write_events

from drive_env.studio import runs_folder, runs_page
from drive_env.studio.runs_compare import compare, figures_of
from drive_env.studio.runs_folder import confined, find_run, kind_of, list_runs, media_type, settings_of, url_of

SECRET = "not for visitors"
CERTIFICATE = {
    "tuner": "auto", "device": "tmcm1636", "axes": [{
        "axis": 0, "accepted": True, "reservations": [], "before": [1, 2], "after": [3, 4], "hardware_seconds": 11.25,
        "frequency_responses": [{"name": "velocity loop", "tuned": True, "margins": {"phase margin [deg]": 44.0}}],
        "steps": [{"name": "move", "tuned": True, "figures": {"settling [s]": None}},
                  {"name": "move", "tuned": False, "figures": {"settling [s]": 9.0}}],
    }],
}  # fmt: skip


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """A folder with two runs, a film by itself, and things that are nobody's business."""
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "runs"
    for k, name in enumerate(("20260101-100000-auto", "20260102-100000-train")):
        folder = root / name
        (folder / "pictures").mkdir(parents=True)
        (folder / "settings.toml").write_text(f"seed = {k}\n[machine]\nload = 'two_mass'\n")
        (folder / "report.html").write_text("<script>stolen()</script><h1>Report</h1>")
        (folder / "pictures" / "curve.png").write_bytes(b"\x89PNG")
        (folder / ".hidden").write_text(SECRET)
    (root / "20260101-100000-auto" / "certificate.json").write_text(json.dumps(CERTIFICATE))
    (root / "film.webp").write_bytes(b"RIFF")
    (tmp_path / "secret.txt").write_text(SECRET)
    (root / "20260101-100000-auto" / "link.txt").symlink_to(tmp_path / "secret.txt")
    (root / "way_out").symlink_to(tmp_path)
    for k, name in enumerate(("film.webp", "20260101-100000-auto", "20260102-100000-train")):
        os.utime(root / name, (1e9 + k, 1e9 + k))
    return root


@pytest.fixture
def client(runs):
    web = FastAPI()
    runs_page.attach(web, None)
    return TestClient(web)


# --- what is listed -----------------------------------------------------------------------------------------------
def test_the_newest_run_comes_first_and_nothing_hidden_is_listed(runs):
    found = list_runs(runs)
    assert [run.name for run in found] == ["20260102-100000-train", "20260101-100000-auto", "film.webp"]
    assert {file.path for file in found[1].files} == {
        "certificate.json", "pictures/curve.png", "report.html", "settings.toml",
    }  # fmt: skip
    assert [file.kind for file in found[2].files] == ["picture"]


def test_without_a_folder_there_are_no_runs(tmp_path):
    assert list_runs(tmp_path / "runs") == []
    assert find_run("any", tmp_path / "runs") is None


@pytest.mark.parametrize(
    ("name", "kind"),
    [("a.html", "report"), ("a.PNG", "picture"), ("a.webp", "picture"), ("a.mp4", "film"), ("a.toml", "text"),
     ("a.npz", "other"), ("a", "other")],
)  # fmt: skip
def test_a_file_is_shown_by_its_ending(tmp_path, name, kind):
    assert kind_of(tmp_path / name) == kind


@pytest.mark.parametrize("name", ["a.js", "a.xhtml", "a.wasm", "a.npz", "a.xml"])
def test_nothing_is_sent_as_what_a_browser_runs(tmp_path, name):
    assert media_type(tmp_path / name) == "application/octet-stream"


# --- nothing leads out of it ----------------------------------------------------------------------------------------
OUTSIDE = (
    "..", "../secret.txt", "20260101-100000-auto/../../secret.txt", "/etc/passwd", "20260101-100000-auto/link.txt",
    "way_out/secret.txt", "", ".", "a\0b",
)  # fmt: skip


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_path_that_leads_out_is_refused(runs, name):
    with pytest.raises(ValueError):
        confined(name, runs)
    assert find_run(name, runs) is None


@pytest.mark.parametrize(
    "path",
    ["../secret.txt", "..%2Fsecret.txt", "%2e%2e/secret.txt", "20260101-100000-auto/..%2f..%2fsecret.txt",
     "way_out/secret.txt", "20260101-100000-auto/link.txt", "%2Fetc%2Fpasswd", "20260101-100000-auto", "none"],
)  # fmt: skip
def test_no_address_reaches_a_file_outside(client, path):
    answer = client.get(f"/studio/runs/{path}")
    assert answer.status_code == 404
    assert SECRET not in answer.text


def test_a_report_is_sent_without_the_right_to_run_scripts(client):
    answer = client.get(url_of("20260101-100000-auto", "report.html"))
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/html")
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("sandbox; default-src 'none'") and "allow-scripts" not in policy
    assert "script-src" not in policy
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_a_name_with_odd_letters_has_an_address():
    assert url_of("a b#?", "c/ü.png") == "/studio/runs/a%20b%23%3F/c/%C3%BC.png"


# --- comparisons --------------------------------------------------------------------------------------------------
def test_settings_are_flat(runs):
    assert settings_of(find_run("20260101-100000-auto", runs), runs) == {"seed": "0", "machine.load": "two_mass"}


def test_a_certificate_becomes_figures():
    assert figures_of(CERTIFICATE) == {
        "tuner": "auto", "device": "tmcm1636", "verdict": "accepted", "before": "1, 2", "after": "3, 4",
        "hardware seconds": "11.25", "velocity loop: phase margin [deg]": "44", "move: settling [s]": "not measured",
    }  # fmt: skip


@pytest.mark.parametrize("content", ["", "[]", "{", '{"axes": 3}', '{"axes": [1, {}]}', '{"axes": [{"steps": [7]}]}'])
def test_a_certificate_that_is_none_breaks_no_page(runs, content):
    (runs / "20260101-100000-auto" / "certificate.json").write_text(content)
    run = find_run("20260101-100000-auto", runs)
    figures_of(runs_folder.certificate_of(run, runs))


def test_two_runs_are_compared(runs):
    one, other = (find_run(name, runs) for name in ("20260101-100000-auto", "20260102-100000-train"))
    rows = {name: (a, b, differ) for name, a, b, differ in compare(one, other)}
    assert rows["seed"] == ("0", "1", True)
    assert rows["machine.load"] == ("two_mass", "two_mass", False)
    assert rows["verdict"] == ("accepted", "-", True)


# --- learning curves ----------------------------------------------------------------------------------------------


def test_curves_are_read_also_while_they_are_written(runs):
    from agents.studio.curves_part import curve_chart, first_tag
    from agents.studio.event_curves import read_curves

    folder = runs / "20260102-100000-train"
    path = write_events(folder, 10)
    curves = read_curves(folder)
    assert set(curves) == {"rollout/ep_rew_mean", "loss"}
    assert curves["rollout/ep_rew_mean"] == ([100 * k for k in range(10)], [2.0 * k for k in range(10)])
    assert find_run(folder.name, runs).has_events
    assert first_tag(sorted(curves)) == "rollout/ep_rew_mean"
    assert len(curve_chart(curves, ["loss", "rollout/ep_rew_mean"])["series"]) == 2
    path.write_bytes(path.read_bytes()[:-20])  # in the middle of a record
    assert len(read_curves(folder)["loss"][0]) in (8, 9)
    path.write_bytes(b"no events at all")
    assert read_curves(folder) == {}
