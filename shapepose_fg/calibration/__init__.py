"""Where the cameras stand, and when they expose, from the people whom they see."""
