"""Statistics of figures over robots and over training runs: the one place for protocols, comparisons and reports."""
