"""How fast the emulator is, measured in one run against the bound of its parts."""
