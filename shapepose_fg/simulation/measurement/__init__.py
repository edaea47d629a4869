"""How a detector errs, measured on a recording without annotation or truth: real and simulated ones alike."""
