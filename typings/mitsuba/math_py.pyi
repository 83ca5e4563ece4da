# Corrected by .ci/typings.py from the stubs of Mitsuba 3.9.1


def chi2(obs, exp, pool_threshold):
    """
    Pure-Python/numpy port of ``mitsuba::math::chi2()`` for backends that lack
    float64 (e.g. Metal). Cells with expected frequency below ``pool_threshold``
    are pooled into larger groups before contributing to the statistic.

    Returns ``(statistic, dof, n_pooled_in, n_pooled_out)``.
    """

def rlgamma(a, x):
    """Regularized lower incomplete gamma function based on CEPHES"""
