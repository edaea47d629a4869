"""What the pose prior and the learned fitter are taught from: motions, who is left out, and how it is done."""
