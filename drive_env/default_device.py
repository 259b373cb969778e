"""The default device of commands, of emulated drives and of drives on a bus."""

DEFAULT_DEVICE = "tmcm1636"  # a folder of drive_env/devices
