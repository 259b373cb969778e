"""The Drives interface: callers hold it on an emulator and on a bus alike."""
