"""Episodes of a policy, and their evaluation."""
