"""The drive's side of a CANopen network: frames in, frames out, and the object dictionary behind them."""
