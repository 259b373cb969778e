"""Certificates: results and changes of a tuning, with the measurements that prove them."""
