"""Numbers that several steps share: each stands for one idea, and is written here only.

Lengths are standard deviations per axis, unless stated.
"""

DETECTOR_M = 0.03
"""Usual error of a detector's joint, m. Positions that differ by less are the same."""
BODY_M = 0.02
"""Usual distance of a detector's joint from a fitted body's, m."""
WELL_SEEN_M = 0.05
"""Up to this a joint is well seen, m: by two views, not at the end of a ray."""
KNOWN_M = 0.1
"""Up to this the position of a joint is known, m: bones and motion can be computed from it."""
LOST_M = 0.2
"""Above this a joint is lost, m: it may be anywhere within its limb's reach."""
FARTHEST_M = 0.5
"""Maximum distance of a detection from a joint that it can belong to, m."""
ANYWHERE_M = 10.0
"""A joint of which nothing is known, m: as large as a room."""
LEAST_JOINTS = 4
"""Minimum number of joints of a person: three determine a pose, one more allows a check."""
LEAST_VIEWS = 3
"""Minimum number of views that agree: two that agree may both be wrong."""
OUTLIER_SIGMA = 3.0
"""Distance, in standard deviations, above which a measurement is an outlier."""
SURE = 0.95
"""Probability above which something is certain, and of the regions that are reported."""
LIKELY = 6.0
"""Difference of log-likelihoods above which the better of two explanations is certain."""
LOOK_S = 0.3
"""Time in which people move by about a limb's width, s: people are searched for, and compared with
their bodies, once in it."""
RECENT_S = 0.25
"""Time for which the motion of a joint lasts, s: views that saw it within it
determine it."""
LASTS_S = 1.0
"""Time for which errors of detectors last, s: within it, errors count as one."""
SAME_TIME_S = 1e-3
"""Difference of times, s, below which these are the same: a hand at 5 m/s moves by 5 mm."""
WALK_M_S = 1.5
"""Speed of a walking person, m/s."""
ROUNDS = 2
"""Number of rounds in which an assignment and a fit alternate."""
MOST_STEPS = 40
"""Maximum number of steps of iterations that converge before."""
STEP = 1e-4
"""Step of numerical derivatives, rad or m."""
BATCH = 64
"""Number of rows that are processed together: their matrices fit into the cache."""
LARGEST = 1e6
"""Largest number in a file, metres, pixels or hertz: beyond it, doubles are too coarse for joints,
and the file is damaged."""
LONGEST_NAME = 200
"""Maximum number of characters of a name in a file."""
MOST_ITEMS = 2**20
"""Maximum number of items of a file that are kept in memory together; real ones have fewer."""
SAMPLES = 2000
"""Number of samples of bodies from which distances are estimated, to 3 %."""
SAME_PERSON_M = 0.25
"""Mean distance of the joints of two people, m, below which they are one: a pelvis is 20 cm
deep."""
UNSEEN_S = 0.5
"""Time for which somebody or something that is not seen moves on as before, s."""
SPEED_S = 0.05
"""Time over which the velocity of a joint is measured, s: over less, noise dominates."""
HUGE = 1e6
"""As good as infinite: a variance of which nothing follows, a precision that fixes."""
TINY = 1e-6
"""As good as 0, where exactly 0 would make a system singular."""
SURFACE_M = 0.015
"""Additional error of a point on a body's surface, and of its soles, m."""
