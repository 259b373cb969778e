"""What drives' own signals say of motor and machine."""
