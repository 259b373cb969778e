"""A device's folder holds what differs: the rest is in defaults.toml, in its family's file, and in the rule."""

import math
import shutil
from types import SimpleNamespace

import pytest

from drive_env.devices import FOLDER, device_names, find_device
from drive_env.devices.commissioning import RULES, preset
from drive_env.devices.variants import DEFAULTS, FAMILIES, device_data, merged
from mechanics.reading.untrusted import read_toml


def leaves(table, path=()):
    """Yield the path and the value of all that is no table."""
    for name, value in table.items():
        if isinstance(value, dict):
            yield from leaves(value, (*path, name))
        else:
            yield (*path, name), value


@pytest.mark.parametrize("name", [name for name in device_names() if "variant_of" not in device_data(FOLDER / name)])
def test_no_device_repeats_what_is_written_once(name):
    own = read_toml(FOLDER / name / "device.toml")
    before = dict(leaves(read_toml(DEFAULTS)))
    if "like" in own:
        before |= dict(leaves(read_toml(FOLDER / f"{own['like']}.toml")))
    assert [path for path, value in leaves(own) if path in before and before[path] == value] == []


def test_a_folder_of_ones_own_has_what_its_family_has(tmp_path):
    own = tmp_path / "mine"
    shutil.copytree(FOLDER / "tmcm6212", own)
    made, ships = find_device(str(own)), find_device("tmcm6212")
    differ = {"name", "eds", "presets"}
    assert {name for name in made._fields if getattr(made, name) != getattr(ships, name)} == differ
    assert made.preset(made.motors["qsh4218_51"]) == ships.preset(ships.motors["qsh4218_51"])
    (own / "device.toml").write_text(
        (own / "device.toml").read_text().replace('"stepper"  # ..', '"steppers"  # ..', 1)
    )
    find_device.cache_clear()
    with pytest.raises(
        ValueError, match=r"device.toml: like = 'steppers' names no family of devices; there are stepper"
    ):
        find_device(str(own))


def test_what_a_folder_says_goes_before_the_defaults():
    assert merged({"a": 1, "t": {"b": 2, "c": 3}}, {"t": {"c": 4}, "d": 5}) == {"a": 1, "t": {"b": 2, "c": 4}, "d": 5}
    assert all((FOLDER / f"{family}.toml").is_file() for family in FAMILIES)


def test_a_commissioning_has_quantities_integers_and_what_is_left_out(monkeypatch):
    monkeypatch.setitem(RULES, "servo", lambda device, motor: {"speed": 100.4, "hall": motor.hall})
    objects = {
        "window": 200, "speed": {"of": "speed"}, "fast": {"of": "speed", "times": 10, "per": 4},
        "hall": {"of": "hall", "unless": 0},
    }  # fmt: skip
    table = {"rule": "servo", "objects": objects}
    assert preset(None, SimpleNamespace(hall=0), table) == {"window": 200, "speed": 100, "fast": 251}
    assert list(preset(None, SimpleNamespace(hall=1), table).items())[-1] == ("hall", 1)


@pytest.mark.parametrize(("table", "text"), [
    ({"rule": "linear", "objects": {}}, "no rule is named 'linear'; there are servo, stepper"),
    ({"rule": "stepper", "objects": {"a": {"of": "rpm"}}}, "a has no quantity 'rpm'; there are microsteps, full_steps"),
])  # fmt: skip
def test_a_commissioning_that_cannot_be_says_what_there_is(table, text):
    device = find_device("tmcm6212")
    motor = device.motors[device.default_motor]
    with pytest.raises(ValueError, match=text):
        preset(device, motor, table)


def test_the_chopper_is_quick_for_a_winding_whose_current_would_ripple():
    device = find_device("tmcm6212")
    motor = device.motors[device.default_motor]
    slow = motor._replace(L_q=1.0)
    found = [RULES["stepper"](device, one) for one in (slow, slow._replace(L_q=1e-5))]
    assert [(one["blank_time"], one["off_time"]) for one in found] == [(0, 0), (1, 3)]
    assert math.isclose(found[0]["speed"], 2 * 4 * motor.n_p * 256)
