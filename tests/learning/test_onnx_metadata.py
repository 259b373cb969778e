"""An ONNX file of somebody: its metadata are checked, and its size, before anything acts by it."""

import json

import pytest
from typer.testing import CliRunner

from agents.commands.cli import app
from agents.policies.agent_file import BundleError
from agents.policies.onnx_export import export
from agents.policies.onnx_policy import METADATA, OnnxPolicy
from agents.policies.policy import load_policy
from agents.shipped import shipped

pytestmark = pytest.mark.usefixtures("files_read_here")

pytest.importorskip("onnxruntime")
onnx = pytest.importorskip("onnx")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    path = tmp_path_factory.mktemp("onnx") / "agent.onnx"
    export(load_policy(shipped("tracking_two_mass")).bundle, path)
    return path


def with_metadata(path, text, to):
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {METADATA: text})
    onnx.save(model, to)
    return to


@pytest.mark.every(6)
@pytest.mark.parametrize(
    "text",
    ["no", "[]", "5", "null", "NaN", "[" * 100_000, '{"environment": 5}', '{"configuration": 5}', '{"card": [1]}',
     '{"environment": "x", "configuration": Infinity}', '{"card": {"trained": 1e999}}'],
)  # fmt: skip
def test_metadata_that_are_not_ours(text, exported, tmp_path):
    path = with_metadata(exported, text, tmp_path / "odd.onnx")
    with pytest.raises(BundleError, match=r"odd\.onnx: its metadata"):
        OnnxPolicy(path)
    found = CliRunner().invoke(app, ["evaluate", str(path), "--card"])
    assert found.exit_code == 2 and isinstance(found.exception, SystemExit)
    assert found.output.strip().count("\n") == 0


def test_metadata_of_ours_and_none_are_taken(exported, tmp_path):
    assert OnnxPolicy(exported).environment == "ServoDrive/Tracking-v0"
    plain = with_metadata(exported, json.dumps({}), tmp_path / "plain.onnx")
    assert OnnxPolicy(plain).environment is None and OnnxPolicy(plain).card == {}


@pytest.mark.every(3)
@pytest.mark.parametrize("content", [b"", b"no", bytes(1000)])
def test_what_is_no_model_is_told(content, tmp_path):
    (tmp_path / "odd.onnx").write_bytes(content)
    with pytest.raises(BundleError, match=r"odd\.onnx is not an ONNX model"):
        OnnxPolicy(tmp_path / "odd.onnx")


def test_a_model_that_is_too_large_is_not_opened(tmp_path):
    with (tmp_path / "large.onnx").open("wb") as file:
        file.truncate(1 << 40)
    found = CliRunner().invoke(app, ["evaluate", str(tmp_path / "large.onnx")])
    assert found.exit_code == 2 and "and 100 MB are read" in found.output
