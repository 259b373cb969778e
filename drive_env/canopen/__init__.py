"""The drive's side of a CANopen network: services, and the object dictionary behind them."""
