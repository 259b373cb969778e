"""One button: identify, compute, try, verify, keep or roll back."""
