"""`drive-env studio`: a local web page for a set of drives, through the Drives interface and its safety envelope.

`session.py` owns the drives in one thread; `shared_drives.py` is the interface for its jobs; `recorder.py` stores
samples; `presence.py` tracks open browser pages and their motions; `page.py` defines the pages; `server.py`, `gate.py`
and `layout.py` are the web server. Pages of other packages register in the entry-point group `drive_env.studio_pages`.
"""
