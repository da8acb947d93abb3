"""Methods x datasets x seeds: run alike, judged alike, told in one report."""
