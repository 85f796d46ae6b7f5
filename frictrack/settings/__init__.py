"""What a user sets, as records: filters, priors, repairs of tracks, costs of runs."""
