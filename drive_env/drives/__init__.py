"""The Drives interface: what callers of drives hold, on an emulator and on a bus alike."""
