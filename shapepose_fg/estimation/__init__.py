"""Stage II: estimates people's joints together with their bodies (section 3.2 of the paper)."""
