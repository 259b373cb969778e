"""What an emulator has inside, which no page and no master has told."""

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.firmware.common.brake import CLOSED, WITH_OUTPUT, WITH_STAGE
from drive_env.firmware.record import LANES, get_lanes
from tuning.snapshot import DEVICE_OBJECTS, take_of

# What an axis does, not what it is set to: the state, positions and what follows from them, signals. Where home is
# (2140h) is lost with the power; 6060h cannot be 0 again once a drive had a mode.
LIVE = {
    0x1001, 0x1003, 0x2031, 0x2041, 0x2042, 0x2043, 0x2060, 0x2100, 0x2101, 0x2102, 0x2103, 0x2104, 0x2105, 0x2140,
    0x2702, 0x6040, 0x6041, 0x6060, 0x6061, 0x6062, 0x6063, 0x6064, 0x606B, 0x606C, 0x6077, 0x6078, 0x607A, 0x60F4,
    0x60FC, 0x60FD,
}  # fmt: skip


def settings_of(drives):
    """Every object of a drive that can be read and is no signal, read one by one."""
    found = {}
    for entry in drives.device.new_dictionary():
        try:
            value = drives.read((entry.index, entry.sub))[0]
        except ObjectAccessError:
            continue
        if entry.index not in LIVE or (entry.index, entry.sub) in gains_of(drives):
            found[entry.index, entry.sub] = value
    assert len(found) > 100
    return found


def gains_of(drives):
    return set(drives.device.gains.keys)


def truth_of(drives):
    """Return of the first axis: parameters by index and sub-index as text, whether its stage is on, speed [rad/s]."""
    kept = {key: value for key, value in take_of(drives, {}).axes[0].items() if key[0] >= DEVICE_OBJECTS}
    records = drives.inside.records
    return {
        "parameters": {f"{index:04X}:{sub:02X}": int(value) for (index, sub), value in kept.items()},
        "is_on": bool(records["stage_on"].reshape(-1, LANES)[0, 0]),
        "speed": float(records["omega_m"].reshape(-1, LANES)[0, 0]),
    }


def field(drives, name, part=0):
    """A field of the record of every axis, shape (num_axes,)."""
    return get_lanes(drives.inside.records, name, drives.num_axes, part).astype(float)


def brake_is_closed(drives):
    """Whether the brake of each axis holds, shape (num_axes,)."""
    mode = field(drives, "brake_mode")
    shut = (mode == WITH_STAGE) & (field(drives, "stage_on") == 0) | (mode == WITH_OUTPUT) & (
        field(drives, "brake_opened") == 0
    )
    return (mode == CLOSED) | shut
