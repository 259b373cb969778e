"""From what is known of an axis to gains, by rules."""
