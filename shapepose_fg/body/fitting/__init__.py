"""From joints to bodies: the energy, the fitters, and what a body says of a joint without its own target."""
