"""Looking back at runs: which recordings there are, what each says, how moduli change over the days, and one page a run."""
