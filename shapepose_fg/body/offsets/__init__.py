"""Where a detector puts its joints on the body, learnt without truth."""
