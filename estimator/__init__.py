"""Pure computation, without input or output: excitation, arm models, Fourier analysis, estimators, uncertainty."""
