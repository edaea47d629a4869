"""People's joints in pictures: a heat-map network, and its output as candidates with part affinities."""
