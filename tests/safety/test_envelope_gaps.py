"""Paths past the envelope that an audit of its specification found."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.foreign_eds import ABORT_CONNECTION, ENCODER_RESOLUTION, MAX_PROFILE_VELOCITY, foreign
from rigs.scripted_drive import ScriptedBus, ScriptedDrive

from drive_env import CanDrives, Limits, SafetyError, motion
from drive_env.devices import find_device
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.errors import NoAnswerError

TURN = 65536
SCALE, CURRENT, STORE = (0x2058, 0), (0x2003, 0), (0x1010, 1)
SAVE = 0x65766173


@pytest.fixture
def drive():
    return ScriptedDrive(values={SCALE: (TURN, 4), (0x6085, 0): (1000 * TURN, 4), (0x605A, 0): (2, 2)})


@pytest.fixture
def bus(drive):
    with ScriptedBus(drive) as made:
        yield made


def intercept(drive, act):
    """Have `act(index, value, truly)` done instead of each write; `truly(value)` writes."""
    plain = drive.set

    def write(index, value, sub=0):
        act(index, value, lambda other: plain(index, other, sub))

    drive.set = write


# --- a watchdog is never changed while it is set ------------------------------------------------------------------
@pytest.mark.parametrize("name", [(0x1016, 1), (0x1029, 1), (0x6007, 0)], ids=["1016h", "1029h", "6007h"])
@pytest.mark.parametrize("is_enabled", [True, False], ids=["enabled", "disabled again"])
def test_a_program_does_not_change_its_own_watchdog(tmp_path, bus, drive, name, is_enabled):
    drive.values[0x6007, 0] = (1, 2)
    with CanDrives(eds=foreign(tmp_path, ABORT_CONNECTION), bus=bus) as drives:
        motion.enable(drives, mode="csv")
        if not is_enabled:
            motion.disable(drives)
        before = drive.get(*name)
        with pytest.raises(SafetyError, match="belongs to the watchdog by which the drive notices"):
            drives.write(name, 0 if name != (0x1029, 1) else 1)
        assert drive.get(*name) == before
        motion.disable(drives)


def test_before_it_is_set_they_are_the_programs(bus, drive):
    with CanDrives(bus=bus) as drives:
        drives.write((0x1029, 1), 1)
        motion.enable(drives, mode="csv")
        assert drive.get(0x1029, 1) == 0
        motion.disable(drives)
    assert drive.get(0x1029, 1) == 1


def test_a_watchdog_that_is_not_put_back_is_told(bus, drive, caplog):
    drive.set(0x1029, 1, 1)
    intercept(drive, lambda index, value, truly: truly(0 if index == 0x1029 else value))
    with CanDrives(bus=bus) as drives:
        motion.enable(drives, mode="csv")
        motion.disable(drives)
    assert "node 1: 1029h:01 should have 01 again, and has 00" in caplog.text


def test_lockstep_that_cannot_be_proved_is_refused(bus, drive):
    del drive.values[0x1017, 0]
    said = pytest.raises(SafetyError, match=r"no producer heartbeat \(1017h\) that would show that time waits")
    with CanDrives(bus=bus, pace="lockstep") as drives, said:
        motion.enable(drives, mode="csv")
    assert drive.get(0x6040) != 0x0F


# --- a further axis by an index of its own ------------------------------------------------------------------------
@pytest.fixture
def two_axes(tmp_path):
    """Return an EDS that lists the objects of the second axis, too."""
    numbers = (0x6040, 0x6041, 0x607A, 0x60FF)
    text = find_device("tmcm1636").eds.read_text(encoding="cp1252")
    listed = "".join(f"{900 + k}=0x{index + 0x800:04X}\n" for k, index in enumerate(numbers))
    text = text.replace("=0x6040\n", "=0x6040\n" + listed, 1)
    for index in numbers:
        section = text[text.index(f"[{index:04X}]") :]
        text += "\n" + section[: section.index("[", 1)].replace(f"{index:04X}", f"{index + 0x800:04X}")
    path = tmp_path / "two.eds"
    path.write_text(text, "cp1252")
    return path


@pytest.mark.parametrize("command", [
    lambda drives: drives.write(0x6840, 0x0F),
    lambda drives: drives.write(0x68FF, 1000),
    lambda drives: drives.record([0x6064], 0.002, play={0x6840: [7, 15]}),
], ids=["a controlword", "a set-point", "a play"])  # fmt: skip
def test_an_axis_is_not_commanded_past_the_envelope_by_its_own_index(two_axes, command):
    drive = ScriptedDrive(values={SCALE: (TURN, 4), (0x6085, 0): (1000 * TURN, 4), (0x605A, 0): (2, 2)}, axes=2)
    drive.set(0x6840, 0x06)
    drive.set(0x6840, 0x07)
    with ScriptedBus(drive) as bus, CanDrives(eds=two_axes, bus=bus, pace="lockstep") as drives:
        assert drives.num_axes == 2 and drives.read(0x6841).shape == (2,)
        with pytest.raises(SafetyError, match=r"of axis 1 of a node, and is not monitored by this index"):
            command(drives)
    assert (drive.get(0x6840), drive.get(0x68FF)) in ((0x07, 0), (0x00, 0))


# --- no stop coasts -----------------------------------------------------------------------------------------------
def test_a_quick_stop_is_a_ramp_also_after_parameters_were_stored(bus, drive):
    drive.values |= {(0x605A, 0): (0, 2), STORE: (0, 4)}
    stored = []
    intercept(drive, lambda index, value, truly: (truly(value), index == 0x1010 and stored.append(drive.get(0x605A))))
    with CanDrives(bus=bus, pace="lockstep") as drives:
        motion.enable(drives, mode="csv")
        with pytest.raises(SafetyError, match="while an axis is enabled; nothing was sent"):
            drives.write(STORE, SAVE)
        assert not stored and drive.get(0x605A) == 2
        motion.disable(drives)
        drives.write(STORE, SAVE)
        assert stored == [0]
        drive.refusals[STORE] = 0x08000020
        with pytest.raises(ObjectAccessError):
            drives.write(STORE, SAVE)
        motion.enable(drives, mode="csv")
        assert drive.get(0x605A) == 2
        motion.disable(drives)
    assert drive.get(0x605A) == 0


COASTING = [(0x605A, 2), (0x605C, 1), (0x605D, 1), (0x605E, 2)]


@pytest.fixture
def coasting_eds(tmp_path):
    """Return the EDS of a drive whose options may be 0."""
    path = foreign(tmp_path)
    text = path.read_text(encoding="utf-8")
    for index, _ in COASTING:
        start = text.index(f"[{index:04X}]")
        end = text.index("[", start + 1)
        lines = [line for line in text[start:end].splitlines() if not line.startswith(("LowLimit", "HighLimit"))]
        text = text[:start] + "\n".join(lines) + "\n\n" + text[end:]
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(("index", "ramp"), COASTING, ids=lambda value: f"{value:X}")
@pytest.mark.parametrize("when", ["before", "disabled", "enabled"])
def test_no_option_lets_an_axis_coast_while_it_is_ours(coasting_eds, bus, drive, index, ramp, when):
    drive.values |= {(key, 0): (code, 2) for key, code in COASTING}
    drive.values[index, 0] = (0 if when == "before" else ramp, 2)
    had = []
    with CanDrives(eds=coasting_eds, bus=bus, pace="lockstep") as drives:
        if when == "disabled":
            drives.write(0x60FF, 0)
            drives.write(index, 0)
        motion.enable(drives, mode="csv")
        intercept(drive, lambda to, value, truly: (truly(value), had.append((to, value))))
        if when == "enabled":
            drives.write(index, 0)
        assert drive.get(index) == ramp and (index, 0) not in had
        assert drives.read(index)[0] == 0  # the program's own
        motion.disable(drives)
    assert drive.get(index) == 0


def test_rows_that_disable_where_that_coasts_are_refused(coasting_eds, bus, drive):
    drive.values |= {(key, 0): (code, 2) for key, code in COASTING} | {(0x605C, 0): (0, 2)}
    drive.refusals[0x605C, 0] = 0x06090030  # it takes no ramp
    said = pytest.raises(SafetyError, match="take the voltage away after they have enabled it")
    with CanDrives(eds=coasting_eds, bus=bus, pace="lockstep") as drives, said:
        drives.record([0x6064], 0.005, play={0x6040: [6, 7, 15, 15, 7]})


# --- limits stay where the rotor is -------------------------------------------------------------------------------
def rescaled(drive):
    """Have 6064h follow its scale, as drives do."""

    def write(index, value, truly):
        if index == SCALE[0]:
            drive.values[0x6064, 0] = (drive.get(0x6064) * value // drive.get(*SCALE), 4)
        truly(value)

    intercept(drive, write)


@pytest.mark.parametrize("trouble", ["none", "a sample comes between", "the answer is lost"])
def test_the_travel_stays_where_it_is_whatever_comes_between_a_scale_and_its_answer(bus, drive, trouble, monkeypatch):
    drive.set(0x6064, 2 * TURN)
    rescaled(drive)
    with CanDrives(bus=bus, pace="lockstep", timeout=0.05, safety=Limits(position=(-3 * TURN, 3 * TURN))) as drives:
        motion.enable(drives, mode="pp")
        motion.disable(drives)
        drives.advance(0.003)
        envelope, plain = drives.safety, drives.write_axis

        def write(entry, axis, value):
            plain(entry, axis, value)
            if trouble == "a sample comes between":
                envelope.observe({(0x6064, 0): np.array([[drive.get(0x6064)]])}, envelope.epoch)
            if trouble == "the answer is lost":
                raise NoAnswerError("node 1 did not answer")

        monkeypatch.setattr(drives, "write_axis", write)
        try:
            drives.write(SCALE, 1024)
        except NoAnswerError:
            assert trouble == "the answer is lost"
        monkeypatch.undo()
        drives.write("Profile velocity", 1024)
        motion.enable(drives, mode="pp")
        with pytest.raises(SafetyError, match=r"beyond the limits -3072 to 3072"):
            motion.start_move(drives, 4 * 1024)


def test_a_scale_is_not_played_and_positions_are_not_turned_round_in_rows(tmp_path, bus, drive):
    text = foreign(tmp_path).read_text(encoding="utf-8")
    path = tmp_path / "mapped.eds"
    polarity = MAX_PROFILE_VELOCITY.replace("607F", "607E").replace("PDOMapping=0", "PDOMapping=1")
    if "[607E]" not in text:
        text += polarity.replace("0x0007", "0x0005")
    path.write_text(text + ENCODER_RESOLUTION.replace("PDOMapping=0", "PDOMapping=1"), encoding="utf-8")
    drive.values |= {(0x608F, 1): (TURN, 4), (0x608F, 2): (1, 4)}
    with CanDrives(eds=path, bus=bus, pace="lockstep", safety=Limits(position=(-TURN, TURN))) as drives:
        with pytest.raises(SafetyError, match="changes the scale of positions, and is not played"):
            drives.record([0x6064], 0.002, play={(0x608F, 1): [1024, 1024]})
        with pytest.raises(SafetyError, match="turns positions round"):
            drives.record([0x6064], 0.002, play={0x607E: [0, 0x80]})


def test_a_target_whose_answer_was_lost_counts(bus, drive, monkeypatch):
    drive.values |= {(0x60B0, 0): (0, 4)}
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(position=(-1000, 1000))) as drives:
        motion.enable(drives, mode="csp")
        drives.write(0x607A, 100)
        plain = drives.write_axis

        def write(entry, axis, value):
            plain(entry, axis, value)
            raise NoAnswerError("node 1 did not answer")

        monkeypatch.setattr(drives, "write_axis", write)
        with pytest.raises(NoAnswerError):
            drives.write(0x607A, 600)
        monkeypatch.undo()
        with pytest.raises(SafetyError, match="1001"):
            drives.write(0x60B0, 401)


# --- what was lent is taken back ----------------------------------------------------------------------------------
def test_what_a_drive_made_of_a_lent_limit_is_taken_back(bus, drive):
    intercept(drive, lambda index, value, truly: truly(max(value, 1000) if index == CURRENT[0] else value))
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(current=500)) as drives:
        motion.enable(drives, mode="csv")
        assert drive.get(*CURRENT) == 1000 and drives.read(CURRENT)[0] == 7000
        motion.disable(drives)
    assert drive.get(*CURRENT) == 7000


def test_a_limit_that_is_refused_leaves_the_one_lent_before_to_be_taken_back(bus, drive):
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(current=500)) as drives:
        motion.enable(drives, mode="csv")
        motion.disable(drives)
        drive.refusals[CURRENT] = 0x08000022
        drives.safety.change(Limits(current=400))
        drive.refusals.clear()
        assert drives.read(CURRENT)[0] == 7000
    assert drive.get(*CURRENT) == 7000
