"""Bad input by the thousand: every command ends with status 2 and one line that names what was expected, or works.

    python -m experiments.fuzzing --cases 10000 --seed 0 --out runs/fuzzing

`words` makes command lines, `damage` changes files, `cases` joins both, `judging` runs a case and says how it ended.
"""
