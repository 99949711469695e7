"""GDGS: each term on a sphere of few points."""

from data_tools.claims.gdgs.sphere import measure


def test_the_claim_measures_what_each_term_does():
    found = measure(80, 0)
    assert found["attraction"]["distance"] < 0.7 * found["points"]["distance"]
    assert found["predictor and planes"]["angle"] < 0.5 * found["points"]["angle"]
    assert found["attraction and contraction"]["spacing"] > 1.3 * found["attraction"]["spacing"]
