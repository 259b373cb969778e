"""The servo amplifiers TGZ-D and TGZ-S, read from their manual."""
