"""`drive-env set` where a motor may turn: what enables is refused, what stops goes through, the rest asks."""

from __future__ import annotations

import re

import pytest
from rigs.scripted_drive import ScriptedBus, ScriptedDrive
from typer.testing import CliRunner

from drive_env.commands.cli import app
from drive_env.master.can.error_control import is_of_a_watchdog

DONE, REFUSED, USER_ERROR = 0, 1, 2
OFF, ENABLED, QUICK_STOP, FAULT_REACTION, FAULT = 0x0240, 0x0637, 0x0607, 0x060F, 0x0608


@pytest.fixture
def drive(monkeypatch):
    made = ScriptedDrive(values={(0x2058, 0): (65536, 4), (0x2042, 1): (445, 2)})
    made.buses = []

    def opened(*_, **__):
        made.buses.append(ScriptedBus(made))
        return made.buses[-1]

    monkeypatch.setattr("drive_env.master.can_drives.open_bus", opened)
    monkeypatch.setattr("drive_env.master.can.port.open_bus", opened)
    return made


def put(*arguments, answer=None):
    result = CliRunner().invoke(app, ["set", *map(str, arguments)], input=answer)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def requests(drive):
    """Return what the command asked: "r6041" for a read, "w6040" for a write."""
    kinds = {0x40: "r", 0x20: "w"}
    return [
        f"{kinds[data[0] & 0xE0]}{int.from_bytes(data[1:3], 'little'):04X}"
        for bus in drive.buses
        for data in bus.sent(0x601)
        if data[0] & 0xE0 in kinds
    ]


@pytest.mark.every(7)
@pytest.mark.parametrize("status", [OFF, ENABLED])
@pytest.mark.parametrize(
    "word", ["15", "0x0F", "0x1F", "0x10F", "0x8F", "79"], ids=["on", "hex", "start", "halt", "with reset", "relative"]
)
@pytest.mark.parametrize("options", [(), ("--yes",), ("--raw",), ("--dry-run",)], ids=str)
def test_a_controlword_that_enables_is_refused_with_the_remedy(drive, status, word, options):
    drive.set(0x6041, status)
    code, out, error = put("6040", word, *options)
    assert (code, "w6040" in requests(drive), drive.get(0x6041), "=" in out) == (USER_ERROR, False, status, False)
    assert "would enable the axis, and nothing would monitor the motor after this command ends" in error
    assert "`drive-env jog`" in error and "CanDrives" in error


def test_by_its_name_and_of_a_second_axis_it_is_the_same(drive, tmp_path):
    from drive_env.devices import find_device

    assert put("Controlword", 15)[0] == USER_ERROR
    # The EDS of a drive with two axes lists the objects of the second one, too.
    text = find_device("tmcm1636").eds.read_text(encoding="cp1252").replace("=0x6040\n", "=0x6040\n900=0x6840\n")
    section = text[text.index("[6040]") : text.index("[", text.index("[6040]") + 1)]
    (tmp_path / "two.eds").write_text(text + "\n" + section.replace("6040", "6840"), "cp1252")
    code, _, error = put("6840", 15, "--eds", tmp_path / "two.eds")
    assert (code, "6840h:00 Controlword = 15 would enable" in error) == (USER_ERROR, True), error


@pytest.mark.parametrize("word", [0, 2, 6, 7])
@pytest.mark.parametrize("status", [ENABLED, QUICK_STOP, FAULT_REACTION, FAULT])
def test_a_controlword_that_stops_goes_through_without_a_question_and_first(drive, word, status):
    drive.set(0x6041, status)
    code, out, error = put("6040", word)
    assert (code, drive.get(0x6040)) == (DONE, word), error
    assert out == f"node 1  6040h:00 Controlword = {word} ({word:X}h)\n"
    asked = requests(drive)
    assert not {"r6041", "r2058"} & set(asked[: asked.index("w6040")])


@pytest.mark.every(2)
@pytest.mark.parametrize("word", [0, 6])
def test_what_takes_the_voltage_from_a_motor_that_turns_brings_it_to_rest_first(drive, word):
    """It brakes by 1,000 increments every 50 ms or so; its voltage stays until it stands."""
    left, words, plain = [3], [], drive.set

    def write(index, value, sub=0):
        if index == 0x6040:
            words.append((value, left[0]))
        plain(index, value, sub)
        if index == 0x6040 and value == 2 and left[0]:
            drive.values[0x6041, 0] = (QUICK_STOP, 2)

    class Braking(dict):
        def __getitem__(self, key):
            if key == (0x6064, 0) and left[0]:
                left[0] -= 1
                self[key] = (1000 * (4 - left[0]), 4)
            return super().__getitem__(key)

    drive.set, drive.values = write, Braking(drive.values)
    plain(0x6041, ENABLED)
    code, _, error = put("6040", word)
    assert code == DONE, error
    assert words[0] == (2, 3)
    assert all(value == 2 or rest == 0 for value, rest in words)
    assert words[-1] == (word, 0)


@pytest.mark.parametrize(
    ("name", "value"), [("60FF", 1000), ("607A", 1000), ("6071", 10), ("6060", 3), ("2003", 5000), ("2042:1", 500)]
)
@pytest.mark.parametrize("status", [ENABLED, QUICK_STOP, FAULT_REACTION])
def test_any_other_write_to_a_live_axis_asks_first_and_says_why(drive, name, value, status):
    drive.set(0x6041, status)
    key = int(name[:4], 16), int(name[5:] or 0)
    before = drive.get(*key)
    code, _, error = put(name, value)
    assert (code, drive.get(*key)) == (USER_ERROR, before)
    assert (
        f"node 1 ({status:04X}h) is enabled by its statusword, and reacts at once (to stop it, set 6040 to 2). "
        in error
    )
    assert f" Write {name[:4]}h:0" in error
    assert error.endswith(f" = {value}? There is no terminal to ask; confirm with --yes\n")
    assert put(name, value, "--yes")[0] == DONE
    assert drive.get(*key) == value


@pytest.mark.every(7)
@pytest.mark.parametrize("status", [ENABLED, QUICK_STOP, FAULT_REACTION])
@pytest.mark.parametrize("name", ["1016:1", "100C", "100D", "1029:1"])
@pytest.mark.parametrize("options", [(), ("--yes",), ("--raw", "--yes"), ("--dry-run",)], ids=str)
def test_what_stops_a_live_axis_when_its_master_dies_is_not_changed(drive, name, status, options):
    """Invariant 1: never removed or changed unless the statusword, read back, proves that the axis is off."""
    key = int(name[:4], 16), int(name[5:] or 0)
    drive.values.update({key: (1, {"1016": 4, "100C": 2}.get(name[:4], 1))})
    drive.set(0x6041, status)
    code, out, error = put(name, 0, *options)
    assert (code, out) == (REFUSED, ""), error
    assert "is part of what stops it when its master dies" in error and "drive-env set 6040 2" in error
    assert not [one for one in requests(drive) if one.startswith("w")]
    drive.set(0x6041, OFF)
    assert (put(name, 0)[0], drive.get(*key)) == (DONE, 0)


def test_neither_is_6007h_of_any_axis(drive, tmp_path):
    """CiA 402's abort connection option, which the TMCM-1636 lacks: nothing, or the quick stop."""
    from drive_env.devices import find_device

    text = find_device("tmcm1636").eds.read_text(encoding="cp1252").replace("=0x6040\n", "=0x6040\n900=0x6007\n")
    section = text[text.index("[6040]") : text.index("[", text.index("[6040]") + 1)]
    (tmp_path / "other.eds").write_text(text + "\n" + section.replace("6040", "6007"), "cp1252")
    drive.values[0x6007, 0] = (3, 2)
    drive.set(0x6041, ENABLED)
    code, _, error = put("6007", 0, "--yes", "--eds", tmp_path / "other.eds")
    assert (code, "6007h:00" in error, drive.get(0x6007)) == (REFUSED, True, 3), error
    assert is_of_a_watchdog(0x6807) and not is_of_a_watchdog(0x6807 + 1)


def test_a_watchdog_stays_where_its_statusword_cannot_be_read(drive):
    drive.silent.add((0x6041, 0))
    assert put("1016:1", 0, "--yes", "--timeout", 0.05)[0] == REFUSED
    assert "w1016" not in requests(drive)


def enable_at_the_write(drive, monkeypatch, index, then=ENABLED):
    """Have another master enable the axis when an object is written: after every look, before every answer."""
    plain = drive.set

    def write(one, value, sub=0):
        plain(one, value, sub)
        if one == index and then is not None:
            plain(0x6041, then)

    monkeypatch.setattr(drive, "set", write)


@pytest.mark.parametrize("name", ["1016:1", "100C", "1029:1"])
@pytest.mark.parametrize("state", [ENABLED, QUICK_STOP])
def test_a_watchdog_of_an_axis_that_is_enabled_meanwhile_is_as_it_was(drive, monkeypatch, name, state):
    key = int(name[:4], 16), int(name[5:] or 0)
    drive.values[key] = (1, {"1016": 4, "100C": 2}.get(name[:4], 1))
    enable_at_the_write(drive, monkeypatch, key[0], state)
    code, out, error = put(name, 0, "--yes")
    assert (code, out, drive.get(*key)) == (REFUSED, "", 1)
    assert f"node 1 ({state:04X}h) was enabled by another program while {name[:4]}h:0" in error
    assert ": 1 was written back, as it was before. Stop the axis with drive-env set 6040 2" in error
    asked = [one.replace(name[:4], "....") for one in requests(drive) if one[1:] in {"6041", name[:4]}]
    assert asked[-5:] == ["r6041", "r....", "w....", "r6041", "w...."]


def test_so_is_that_of_an_axis_that_does_not_tell_any_more(drive, monkeypatch):
    drive.values[0x1016, 1] = (0x7F0064, 4)
    plain = drive.set
    monkeypatch.setattr(drive, "set", lambda *written: (plain(*written), drive.silent.add((0x6041, 0))))
    code, _, error = put("1016:1", 0, "--timeout", 0.05)
    assert (code, drive.get(0x1016, 1)) == (REFUSED, 0x7F0064)
    assert "an axis whose statusword could not be read" in error


def test_a_second_master_enables_between_look_and_write(monkeypatch):
    """The whole emulated bus in lockstep: its enabling words arrive right before the write."""
    from rigs.fault_injection import ANSWER, ObservedWorld, WorldBus

    from drive_env import EmulatedDrives
    from drive_env.canopen.frames import Frame

    with EmulatedDrives(num_threads=1) as drives:
        world = ObservedWorld(drives, lockstep=True)
        written = []

        def another_master(request):
            with world.lock:
                world.receive(Frame(0x601, bytes.fromhex(request)), "another master")
                world.cycle()

        class Between(WorldBus):
            def send(self, msg, timeout=None):
                if msg.arbitration_id == 0x601 and msg.data[:4] == bytes.fromhex("23 16 10 01"):
                    if not written:
                        for word in ("06", "07", "0F"):
                            another_master(f"2B 40 60 00 {word} 00 00 00")
                    written.append(int.from_bytes(msg.data[4:], "little"))
                super().send(msg, timeout)

        bus = Between(world)
        another_master("23 16 10 01 64 00 7F 00")  # what it has set for itself
        monkeypatch.setattr("drive_env.master.can_drives.open_bus", lambda *_, **__: bus)
        code, out, error = put("1016:1", 0, "--timeout", ANSWER)
        assert (code, out, world.truth.is_on()[0]) == (REFUSED, "", True), error
        assert re.match(r"drive-env: node 1 \(\w{4}h\) was enabled by another program while 1016h:01", error)
        assert written == [0, 0x7F0064]


@pytest.mark.parametrize("value", ["-1000", "-500 rpm", "-0.5 rev/s"])
@pytest.mark.parametrize("order", ["before", "after", "dashes"])
def test_a_negative_value_is_no_option(drive, value, order):
    options = ["--node", "1", "--raw"] if value == "-1000" else ["--node", "1"]
    words = {"before": [*options, "60FF", value], "after": ["60FF", value, *options],
             "dashes": [*options, "60FF", "--", value]}[order]  # fmt: skip
    code, out, error = put(*words)
    raw = {"-1000": -1000, "-500 rpm": -546133, "-0.5 rev/s": -32768}[value]
    assert (code, drive.get(0x60FF)) == (DONE, raw), error
    assert out.startswith(f"node 1  60FFh:00 Target velocity = {raw}")


def test_what_is_no_number_is_still_an_unknown_option(drive):
    code, _, error = put("60FF", "-z")
    assert (code, "No such option: -z" in error) == (USER_ERROR, True)
    code, _, error = put("60FF", "-1 apples")
    assert (code, "60FFh:00 Target velocity is not a quantity in 'apples'" in error) == (USER_ERROR, True), error


@pytest.mark.parametrize(("kept", "code"), [(1 << 30, DONE), (1 << 31, REFUSED)])
def test_a_bit_of_a_pdos_identifier_that_the_drive_keeps_is_said(drive, monkeypatch, kept, code):
    plain = drive.set
    monkeypatch.setattr(drive, "set", lambda index, value, sub=0: plain(index, value | kept, sub))
    plain(0x6041, OFF)
    plain(0x1800, 0x181, sub=1)
    ended, _, error = put("1800:01", "0x181")
    assert ended == code
    expected = "the drive keeps bit 30 set, which is its to decide" if code == DONE else "reads back another value"
    assert expected in error


def test_a_user_who_says_no_has_changed_nothing(drive, monkeypatch):
    monkeypatch.setattr("typer.testing._NamedTextIOWrapper.isatty", lambda self: True, raising=False)
    monkeypatch.setattr("drive_env.commands.options.typer.confirm", lambda question: False)
    drive.set(0x6041, ENABLED)
    code, _, error = put("60FF", 1000)
    assert (code, error, drive.get(0x60FF)) == (REFUSED, "drive-env: nothing was changed\n", 0)


@pytest.mark.parametrize("status", [OFF, 0x0221, 0x0233, FAULT])
def test_an_axis_that_cannot_turn_is_no_question(drive, status):
    drive.set(0x6041, status)
    assert put("60FF", 1000)[0] == DONE
    assert drive.get(0x60FF) == 1000
