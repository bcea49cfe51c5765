"""How the paper is cited; `CITATION.cff` of the project says the same."""

TITLE = "RoboMME-Interference: Benchmarking Robot Memory Under Interference"
AUTHOR = "Rathi, Soumil"
YEAR, MONTH = 2026, 8
URL = "https://robotmemorybench.com"

BIBTEX = f"""@article{{rathi{YEAR}robommeinterference,
  title  = {{{TITLE}}},
  author = {{{AUTHOR}}},
  year   = {{{YEAR}}},
  month  = {{{MONTH}}},
  url    = {{{URL}}}
}}"""
"""The paper, as BibTeX."""
