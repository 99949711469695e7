"""The profiles of conventions, against a table of what the four rasterisers do."""

import pytest

from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, INRIA, MINI_SPLATTING2, PROFILES, Conventions

# gsplat ends a pixel at T <= 1e-4, INRIA at T < 1e-4. INRIA's backward pass ignores the clamp of alpha altogether, that
# of Mini-Splatting2 for the gradient of the position alone. Values that all share are in the second table.
DIFFERENT = {
    #                  near  alpha_max  stops at =  full support  principal point  symmetric  mean stops  shape stops
    "GSPLAT_MAIN": (0.01, 0.99, True, True, True, False, True, True),
    "GSPLAT_1_5": (0.01, 0.999, True, True, True, False, True, True),
    "INRIA": (0.2, 0.99, False, False, False, True, False, False),
    "MINI_SPLATTING2": (0.2, 0.99, False, True, False, True, False, True),
}
SHARED = {
    "far_plane": 1e10,
    "eps2d": 0.3,
    "is_antialiased": False,
    "alpha_min": 1 / 255,
    "transmittance_min": 1e-4,
}


@pytest.mark.parametrize("profile", [GSPLAT_MAIN, GSPLAT_1_5, INRIA, MINI_SPLATTING2], ids=lambda profile: profile.name)
def test_profiles_are_as_released(profile):
    near, alpha_max, at_equality, support, principal_point, symmetric, mean, shape = DIFFERENT[profile.name]
    assert profile == Conventions(
        name=profile.name,
        near_plane=near,
        alpha_max=alpha_max,
        stops_at_equality=at_equality,
        has_full_support=support,
        uses_principal_point=principal_point,
        clamp_is_symmetric=symmetric,
        clamp_stops_mean_gradient=mean,
        clamp_stops_shape_gradient=shape,
        **SHARED,
    )
    assert PROFILES[profile.name] is profile and PROFILES.keys() == DIFFERENT.keys()
