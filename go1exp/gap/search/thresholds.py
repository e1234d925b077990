"""Tuned constants of the search, each with its measured reason; ``docs/notebook/gap.md`` has the measurements."""

# ---------------------------------------------------------------------- priors, derivatives and bounds

# Standard deviation of a parameter within its tolerance, in tolerances; decides what the data leave open.
PRIOR_SD = 0.5
FREE_PRIOR_SD = 20.0  # standard deviation of a parameter that may leave its tolerance, in tolerances
# Finite difference for a Jacobian, in tolerances: differences over a whole tolerance were off by 5 to 9 %.
DIFFERENCE = 0.1
# Added to a unit diagonal in turn: float32 Gram matrices of collinear columns can be indefinite.
RIDGES = (1e-9, 1e-7, 1e-5)
# Fall of chi2 per value behind an active bound from which its effect is a candidate: at most 0.0011 in null cases.
ACTIVE_BOUND = 0.003
RIVAL_RATIO = 3.0  # largest ratio of two falls of chi2 between which held-out windows decide
MOST_ACTIVE_BOUNDS = 3  # most effects at active bounds that are refitted; each costs a fit
CLEARLY_BEYOND = 1.5  # size in tolerances from which an effect is named where the tolerances close the gap

# ---------------------------------------------------------------------- screening and fits

PROBE = 2.0  # change of a parameter in the screening, in tolerances
# Fall of chi2 per value for an effect without a tolerance: at most 0.0074 in null cases, 0.053 with an effect.
OUTSIDE_BOX = 0.03
# Shares of the largest demanded torque at which a torque limit is screened.
TORQUE_SHARES = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4)
STEP_LENGTHS = (1.0, 0.3)  # lengths of a Gauss-Newton step that are compared
# Fall of the mean log chi2 in a step below which Broyden updates of the Jacobian have no more to give.
BROYDEN_GAIN = 0.003
HOPELESS = 0.4  # share of the best first-step gain below which a candidate is not fitted further
# Fall of log chi2 in a round below which a fit has converged; a further round gains about an eighth of it.
CONVERGED = 0.03
CONVERGED_SHARE = 0.01  # the same as a share of log chi2: beside a large error less decides nothing
GOOD_FIT = 0.01  # log chi2 below which a model without terms needs no more rounds
STEPS_PER_ROUND = 2  # most Gauss-Newton steps before the Jacobian is measured again
FINER_STEPS = 4  # substeps of a physics step in the last fit: errors of 1 ms steps can look like 0.4 ms of delay
NOT_EXCITED = 0.02  # chi2 per value that twice its tolerance must add to some window, or an effect is not excited
SCREENED_WINDOWS = 20  # most windows of the screening
# Most rounds of fitting of a rival of an effect at its bound, which begins at a small part of its size.
RIVAL_ROUNDS = 4
RIVALS = 2  # candidates beside the first term that are compared with several terms
MOST_RELAXED = 3  # most effects that join the tolerance box within their tolerances
# Share of the excess chi-squared from which an insignificant candidate is reported as seen in too few windows.
FEW_WINDOWS_SHARE = 0.5
MANY_TIMES = 3.0  # ratio of values beyond their tolerances from which the other effect is the simpler one
MOST_OF_SMALL = 0.7  # share that a term must remove where the model is adequate already; the right one leaves none
# Fall of chi2 behind a bound from which an effect is listed although the tolerances explain the data.
LISTED_RELIEF = 4.0
ROUNDING = 1e-9  # share of a tolerance by which rounding may carry a clipped value beyond it
PARALLEL = 1e-3  # share of a column's square that others leave, below which they act alike
AT_BOUND = 0.02  # distance from a bound, in tolerances, that counts as at the bound

# ---------------------------------------------------------------------- held-out tests

SIGN_FLIPS = 4000  # sign flips of a test; the smallest p-value is 1 / (SIGN_FLIPS + 1)
SAME_GAIN = 0.02  # difference of gains of log chi2 without meaning: 2 % of the floor, or of the larger gain
WORSE_P = 0.05  # p-value below which a model is worse than another
EQUAL_SHARE = 0.7  # share of the best gain below which a model is no equal, however uncertain
LARGE_ALPHA = 10.0  # factor on ``alpha`` for a candidate that removes ``LARGE_SHARE``
LARGE_SHARE = 0.75  # share of the excess chi-squared that only the right effect, or one that acts alike, removed

# ---------------------------------------------------------------------- the last fit and its intervals

FEWEST_BOOTSTRAPS = 20  # fewest resamples from which an interval is read
LAST_STEPS = 4  # Gauss-Newton steps of the last fit, whose residuals are those of a finer physics step
LAW_SD = 0.04  # relative standard deviation of a value, as no robot follows a law exactly (from sealed cases)

# ---------------------------------------------------------------------- at fewer joints

JOINT_GAIN = 12.0  # fall of chi2 that a joint must bring before it may leave its tolerance
PLAIN_SHARE = 0.05  # share of the largest gain of a joint from which another joint needs no held-out test
LOST_SHARE = 0.6  # share of a term's gain that fewer joints may lose in the linear model and still be fitted
DOUBTFUL_P = 0.05  # held-out p-value from which a joint with a small gain is left out
EQUALITY_DRAWS = 40  # bootstraps of the test that two parameters are equal

# ---------------------------------------------------------------------- one cause of the whole robot

SHARED_DRAWS = 200  # bootstraps of the standard errors of differences between joints
SHARED_LEVEL = 0.05  # level of the test that a value is shared by all joints
CAUSE_STEPS = 4  # Gauss-Newton steps of a single cause: joints that stick make the first ones short
# Factors on fitted values that are compared after a fit, where stiction hides derivatives.
STRETCHES = (1.0, 0.85, 1.15, 1.4)
CAUSE_TURNS = 2  # times that initial states are updated for the best single cause and it is refitted
NEARLY_ALL = 0.8  # share of the held-out excess chi-squared that a single cause must remove
STATE_ROUNDS = 2  # steps of the initial states, by the Jacobian of the nominal model
STATE_STEPS = (1.0, 0.4)  # step lengths of the initial states that are compared in each window
FIRST_RUNG = 2.0  # lowest rung of the ladder of values, in tolerances; each further one is twice as far
RUNG_TRIES = 8  # evaluations between the neighbours of the best rung

# ---------------------------------------------------------------------- two clocks

CLOCK_TERMS = 2  # most terms by each clock before the clocks are compared; the first ones close most of a gap
CLOCK_RESAMPLES = 4000  # bootstraps of the interval of a comparison of clocks
UNEVEN_CLOCK = 0.1  # spread of the steps, in medians, from which written times are reported as uneven

# ---------------------------------------------------------------------- what is certain

QUANTILES = (0.025, 0.975)  # quantiles of a 95 % interval
# Share of the excess chi-squared that a term must remove to be certified beside a gap that remains.
BESIDE_GAP_SHARE = 0.75
# Share of the excess chi-squared above which a term is not withdrawn, and that it must remove on the last check.
HALF = 0.5
MAJORITY = 0.5  # share of the resamples that a term needs which closes a gap (from sealed cases)
BIAS_SD = 0.4  # relative standard deviation per unit of the error amplitude that remains (from sealed cases)
HALF_WIDTH = 1.96  # half width of a 95 % interval, in standard deviations
ACCEPTED_WINDOWS = 0.9  # share of the held-out windows that must be within what the user accepts (chosen)
# Share of a term's largest deviation from which a joint is named although its interval reaches the tolerance.
MUCH = 0.5
