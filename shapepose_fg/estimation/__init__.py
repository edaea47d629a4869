"""Stage II: where exactly people's joints are, in alternation with their bodies (section 3.2 of the paper)."""
