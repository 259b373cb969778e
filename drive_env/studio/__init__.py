"""`drive-env studio`: a local web page for a set of drives, through the Drives interface and its envelope.

`session.py` owns the drives in one thread; `shared_drives.py` is what its jobs get; `recorder.py` keeps what is
sampled; `presence.py` knows which browser pages are there and what they have set in motion; `page.py` lists the pages;
`server.py`, `gate.py` and `layout.py` are the web. Pages of other packages register in the entry-point group
`drive_env.studio_pages`.
"""
