"""Stage descriptions: modes, health parameters, priors, modal map, degradation laws."""
