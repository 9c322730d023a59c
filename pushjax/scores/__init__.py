"""How far a prediction is from what happened: of one pose (`deviation`), of a distribution of them (`distribution`)."""

from pushjax.scores.deviation import deviation as deviation
from pushjax.scores.distribution import coverage as coverage
from pushjax.scores.distribution import energy_score as energy_score
from pushjax.scores.distribution import histogram_distance as histogram_distance
from pushjax.scores.distribution import log_density as log_density
