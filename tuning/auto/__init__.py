"""Automatic tuning: identify, search gains, try, verify, store or roll back."""
