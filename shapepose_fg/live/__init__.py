"""Online reconstruction: the people of the newest frame at once, and refined results within a fixed
lag.
"""
