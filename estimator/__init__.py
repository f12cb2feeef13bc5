"""Mathematics without input or output: excitation, arm model, Fourier analysis, estimators, uncertainty."""
