"""What was found and changed, with the proof."""
