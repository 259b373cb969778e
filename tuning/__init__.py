"""Sweeps, identification, rules and optimisers for drive gains."""
