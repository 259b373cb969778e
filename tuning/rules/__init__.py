"""Rules: from an identified axis to gains."""
