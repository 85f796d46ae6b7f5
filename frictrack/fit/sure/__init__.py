"""How sure a fit is: deviations, correlations, profiles, a bootstrap, and what the runs do not tell, in words."""
