"""Signal processing: segments, spectra, spectral lines, readings of the paper."""
