"""Stage II: estimates people's joints, in alternation with their bodies (section 3.2 of
the paper).
"""
