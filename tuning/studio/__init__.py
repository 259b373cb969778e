"""The pages Commission and Tune of `drive-env studio`: a path to a certificate; gains by hand, responses, rules, auto.

`tune_desk.py` is what all pages of a session share; `tune_jobs.py` asks the drives; `tune_page.py` and the cards are
what people see. Other packages add tuners of their own as parts (`drive_env.studio_parts`), which get the `TunerCard`.
"""
