"""Training of the pose prior and of the learned fitter: motions, splits, and procedure."""
