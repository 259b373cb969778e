"""The device where nobody names one: of commands, of emulated drives and of those on a bus."""

DEFAULT_DEVICE = "tmcm1636"  # a folder of drive_env/devices
