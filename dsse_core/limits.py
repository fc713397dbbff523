"""What a user may state at most, the same wherever it is stated: in a file, on the command line or to a function."""

LONGEST_S = 86400  # of any time: a day
SHORTEST_SCAN_S = 0.001  # between two scans
LEAST_HEARTBEAT_S = 0.001  # between two heartbeats; shorter ones leave no time for anything else
LARGEST_SEED = 2**63 - 1  # the largest integer of TOML
LONGEST_NAME = 64  # letters of the name of an area, a run or a branch; so many has a name in a certificate
LARGEST_BUS = 10**15  # size of the id of a bus, which may be negative: exact as a float, too
SMALLEST_SIGMA, LARGEST_SIGMA = 1e-9, 1e6  # p.u. or rad
# Between these its square, the reciprocal of that and J are numbers: sigmas that are given in arrays.
LEAST_USABLE_SIGMA, MOST_USABLE_SIGMA = 1e-100, 1e100
LARGEST_GROSS_ERROR = 1e9  # standard deviations of the meter
