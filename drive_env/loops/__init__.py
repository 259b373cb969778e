"""Control loops of a drive and its machine as linear systems: open loops, margins, dynamics."""
