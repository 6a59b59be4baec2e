"""The encoder ``second_look``, held against geometry worked out apart from it."""

import itertools

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from pydantic import ValidationError

from encoders.cameras import Pinhole
from encoders.second_look import IMAGES_AT_ONCE, SecondLook
from encoders.spaces import DepthImage, RgbImage

FOCAL_PX = 60.0
PINHOLE = Pinhole(FOCAL_PX, FOCAL_PX, 36.0, 24.0)
HEIGHT, WIDTH, CELL, STRIDE = 49, 74, 3, 2  # a row and two columns are left over
SPACE = DepthImage(HEIGHT, WIDTH, (0.4, 2.0), pinhole=PINHOLE)
MIDDLE_M = np.sqrt(0.4 * 2.0)
FIRST, SECOND, VALUES = 3, 2, 4
SIZES = {"first_keypoints": FIRST, "second_keypoints": SECOND, "values": VALUES}


def make(space=SPACE, **other):
    torch.manual_seed(0)
    settings = SecondLook.Settings(cell=CELL, patch=4, stride=STRIDE, **SIZES, **other)
    return SecondLook(space, settings)


def attending_to_all():
    """An encoder both of whose looks attend to everything alike."""
    encoder = make()
    for part in (
        encoder.attention.weight,
        encoder.queries.out.weight,
        encoder.queries.out.bias,
    ):
        torch.nn.init.zeros_(part)
    return encoder


def places(features):
    """Means and covariances in metres of features (B, f): of the first look, then the second."""
    found = []
    for part, maps in zip(
        features.split([count * (9 + VALUES) for count in (FIRST, SECOND)], dim=1),
        (FIRST, SECOND),
        strict=True,
    ):
        points = part[:, : 3 * maps].reshape(-1, maps, 3).double() * 3 / 10
        points[..., 2] += MIDDLE_M
        covariances = part[:, 3 * maps : 9 * maps].reshape(-1, maps, 6) / 100
        found += [points.detach().numpy(), covariances.detach().numpy()]
    return found


def middles(depth_m):
    """Points (n, 3) at the patches' middle cells: every second cell, starting with (1, 1)."""
    cells_m = depth_m[: HEIGHT // CELL * CELL, : WIDTH // CELL * CELL]
    z = cells_m.reshape(HEIGHT // CELL, CELL, WIDTH // CELL, CELL).mean((1, 3))[
        1::STRIDE, 1::STRIDE
    ]
    rows, columns = (STRIDE * np.indices(z.shape) + 1) * CELL + 0.5 * CELL
    return np.stack([(columns - 36.0) / FOCAL_PX * z, (rows - 24.0) / FOCAL_PX * z, z], -1)


def raw(depth_m):
    return torch.from_numpy(SPACE.encode(np.array(depth_m)[None]))


def slanted():
    """A plane that leans back, less than 3 cm from pixel to pixel of a cell."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return (0.9 + 0.004 * rows + 0.002 * columns).round(3)


def test_both_looks_tell_mean_and_covariance_of_what_they_attend_to():
    points = middles(slanted()).reshape(-1, 3)
    expected = np.cov(points.T, bias=True)[np.triu_indices(3)].clip(-0.03, 0.03)
    mean, covariance, second_mean, second_covariance = places(attending_to_all()(raw(slanted())))
    for place in (*mean[0], *second_mean[0]):
        np.testing.assert_allclose(place, points.mean(0), atol=2e-5)
    for found in (*covariance[0], *second_covariance[0]):
        np.testing.assert_allclose(found, expected, atol=2e-5)


def test_a_query_of_places_leads_the_second_look_there():
    encoder = attending_to_all()
    with torch.no_grad():
        # The first map of the second look: 5 for each decimetre to the right.
        encoder.queries.out.bias[encoder.queries._sizes[0]] = 5.0
    points = middles(slanted()).reshape(-1, 3)
    weights = np.exp(5.0 * 10.0 * points[:, 0])
    expected = (weights[:, None] * points).sum(0) / weights.sum()
    mean, _, second_mean, _ = places(encoder(raw(slanted())))
    np.testing.assert_allclose(second_mean[0, 0], expected, atol=2e-5)
    np.testing.assert_allclose(second_mean[0, 1], mean[0, 0], atol=2e-5)
    assert expected[0] > points[:, 0].mean() + 0.2


def test_where_the_second_look_goes_depends_on_what_the_first_one_found():
    encoder = attending_to_all()
    torch.nn.init.normal_(encoder.queries.out.weight)
    left, right = np.full((2, HEIGHT, WIDTH), np.inf)
    left[:, :40] = right[:, 34:] = 0.9
    both = np.full((HEIGHT, WIDTH), 0.9)
    queries = []
    encoder.queries.register_forward_hook(lambda *arguments: queries.append(arguments[2][0]))
    for image in (left, right, both):
        encoder(raw(image))
    assert not torch.allclose(queries[0], queries[1])
    assert not torch.allclose(queries[0], queries[2])


def test_logits_that_spread_too_far_are_scaled_down_over_what_was_seen():
    encoder = make(logit_std=2.0)
    logits = torch.tensor([[10.0, 1.0], [4.0, 0.0], [10.0, 1.0], [4.0, 0.0], [1e3, -1e3]])
    unseen = torch.tensor([False, False, False, False, True])
    bounded = encoder._bounded(logits[None], unseen[None, :, None])[0]
    wide, narrow = bounded[:4].T  # standard deviations of 3 and 0.5
    assert wide.tolist() == pytest.approx([2.0, -2.0, 2.0, -2.0])
    assert narrow.tolist() == pytest.approx([0.5, -0.5, 0.5, -0.5])
    nothing_seen = encoder._bounded(logits[None], torch.ones(1, 5, 1, dtype=torch.bool))
    assert nothing_seen.isfinite().all()


@pytest.mark.parametrize("limit", [1e-3, 1e3])
def test_limits_that_can_not_be_calculated_with_are_refused(limit):
    with pytest.raises(ValidationError, match="logit_std"):
        SecondLook.Settings(logit_std=limit)


def test_bounded_logits_leave_no_map_on_one_patch_alone():
    encoder = make(logit_std=2.0)
    for layer in (encoder.queries.out.weight, encoder.queries.out.bias):
        layer.data *= 1e4
    points = middles(slanted()).reshape(-1, 3)
    mean, _ = places(encoder(raw(slanted())))[2:]
    furthest = (points.max(axis=0) - points.min(axis=0)) / 2
    assert (abs(mean[0] - points.mean(axis=0)) < furthest).all()  # no corner alone


def test_standardised_queries_do_not_depend_on_the_scale_of_features():
    queries = make(normalize_queries=True).queries
    features = torch.randn(2, FIRST * (9 + VALUES))
    for one, other in zip(queries(features), queries(3.0 * features + 1.0), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_what_was_not_seen_gets_no_attention():
    depth_m = slanted()
    depth_m[:, 36:] = np.inf
    points = middles(slanted())[:, :6].reshape(-1, 3)
    mean, _, second_mean, _ = places(attending_to_all()(raw(depth_m)))
    np.testing.assert_allclose(mean[0, 0], points.mean(0), atol=2e-5)
    np.testing.assert_allclose(second_mean[0, 0], points.mean(0), atol=2e-5)


def test_half_of_the_pixels_missing_moves_places_by_a_few_millimetres():
    rng = np.random.default_rng(0)
    holed = np.where(rng.random((32, HEIGHT, WIDTH)) < 0.5, np.inf, slanted())
    encoder = attending_to_all()
    (whole, *_), (found, *_) = (
        places(encoder(raw(slanted()))),
        places(encoder(torch.from_numpy(SPACE.encode(holed)))),
    )
    error_m = np.linalg.norm(whole - found, axis=-1)
    assert 0.0 < np.median(error_m) < 0.003


def test_shapes_tell_where_in_a_cell_an_edge_is():
    shapes = []
    for column in (30, 31, 32, 33):
        step = np.full((HEIGHT, WIDTH), 1.7)
        step[:, :column] = 0.8
        shapes.append(make()._look(torch.from_numpy(step[None]).float())[0])
    covered = [shape.unflatten(-1, (3, 4, 4))[:, :, 1].sum() for shape in shapes]
    differences = [(a - b).abs().max() for a, b in itertools.pairwise(shapes)]
    assert min(differences) >= 1 / 3 - 1e-6
    assert len({float(total) for total in covered}) > 1


def test_shapes_do_not_depend_on_how_far_away_they_are_nor_the_background():
    step = np.full((HEIGHT, WIDTH), 1.0)
    step[:, 30:] = 0.8
    far = np.where(step > 0.9, 1.7, step)
    nearer = np.where(step > 0.9, 1.5, 0.6)
    shapes = [make()._look(torch.from_numpy(i[None]).float())[0] for i in (step, far, nearer)]
    torch.testing.assert_close(shapes[0], shapes[1])
    torch.testing.assert_close(shapes[0], shapes[2])


def test_an_empty_image_has_finite_features_and_gradients():
    encoder = make()
    features = encoder(raw(np.full((HEIGHT, WIDTH), np.inf)))
    features.square().sum().backward()
    assert torch.isfinite(features).all()
    assert all(torch.isfinite(p.grad).all() for p in encoder.parameters())


def test_every_parameter_learns_from_an_image():
    encoder = make()
    encoder(raw(slanted())).square().sum().backward()
    still = [n for n, p in encoder.named_parameters() if p.grad is None or not p.grad.any()]
    # A softmax does not depend on what all of its logits have in common.
    assert still in ([], ["attention.bias"])


def test_images_are_encoded_alike_alone_and_together():
    rng = np.random.default_rng(0)
    images = rng.integers(400, 2000, (IMAGES_AT_ONCE + 3, HEIGHT, WIDTH, 1), np.uint16)
    encoder = make()
    together = encoder(torch.from_numpy(images))
    alone = encoder(torch.from_numpy(images[-1:]))
    torch.testing.assert_close(together[-1:], alone, atol=1e-4, rtol=1e-4)
    assert together.shape == (len(images), encoder.features_dim)


def test_bfloat16_moves_places_by_little():
    exact, *_ = places(make()(raw(slanted())))
    lowered, *_ = places(make(precision="bfloat16")(raw(slanted())))
    assert 0 < np.abs(exact - lowered).max() < 0.02


def test_another_camera_looks_along_its_own_rays():
    wider = Pinhole(45.0, 51.0, 33.0, 27.0)
    encoder = make()
    encoder.set_rays(wider.rays(HEIGHT, WIDTH))
    expected = make(DepthImage(HEIGHT, WIDTH, (0.4, 2.0), pinhole=wider))(raw(slanted()))
    torch.testing.assert_close(encoder(raw(slanted())), expected)
    assert not torch.allclose(make()(raw(slanted())), expected)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (RgbImage(60, 60), "only depth images"),
        (Box(-1, 1, (6,)), "only depth images"),
        (DepthImage(60, 60), "declare its DepthImage with a pinhole"),
        (DepthImage(60, 11, pinhole=PINHOLE), "11x60 image .* patch of 4 cells of 3 pixels"),
    ],
)
def test_spaces_that_make_no_points_are_refused(space, message):
    with pytest.raises(ValueError, match=message):
        make(space)
