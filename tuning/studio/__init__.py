"""The pages Commission and Tune of `drive-env studio`: a path to a certificate; gains by hand, responses, rules, auto.

`tune_desk.py` is the state that all pages of a session share; `tune_jobs.py` has the jobs on the drives; `tune_page.py`
and the cards are the user interface. Other packages add tuners as parts (`drive_env.studio_parts`), which get the
`TunerCard`.
"""
