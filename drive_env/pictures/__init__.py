"""Pictures of machines and signals, and films of them."""
