"""One style for all figures: distinguishable colors, and the properties of the files."""

import itertools

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_rgb

mpl.use("Agg")

import matplotlib.pyplot as plt

from pushjax import plot
from pushjax.plot.style import BLACK, GRAY, RED, SERIES, curve_styles

# Severe protanopia, deuteranopia and tritanopia on linear RGB (Machado, Oliveira & Fernandes 2009)
BLIND = (
    ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
    ((1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)),
)


def lab(linear: np.ndarray) -> np.ndarray:
    """Return the color in CIE Lab under D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = to_xyz @ linear / [0.9505, 1, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def seen_by(color, eyes) -> np.ndarray:
    c = np.array(to_rgb(color))
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return lab(np.clip(np.asarray(eyes) @ linear, 0, 1))


@pytest.mark.parametrize("eyes", [np.eye(3), *BLIND], ids=["full", "protan", "deutan", "tritan"])
def test_colors_can_be_told_apart(eyes):
    """Colors of curves differ by at least 15, those of a push's moments by 40; a difference of 2.3 is just visible."""
    for colors, least in (([color for color, _ in SERIES], 15), ((BLACK, GRAY, RED), 40)):
        for a, b in itertools.combinations(colors, 2):
            assert np.linalg.norm(seen_by(a, eyes) - seen_by(b, eyes)) > least, (a, b)


def test_moments_in_grayscale():
    lightness = sorted(seen_by(color, np.eye(3))[0] for color in (BLACK, RED, GRAY, "white"))
    assert np.diff(lightness).min() > 20


def test_curves_can_be_told_apart():
    """Color and dash differ between curves. A model has the same ones in every picture."""
    with pytest.raises(ValueError, match="at most 6 curves can be distinguished; got 7: a, b"):
        curve_styles(dict.fromkeys("abcdefg", 0))
    looks = [tuple(map(str, look.values())) for _, _, look in curve_styles(dict.fromkeys("abcdef", 0))]
    for column in zip(*looks, strict=True):
        assert len(set(column)) == 6
    one, other = curve_styles({"quartic": 0, "ellipsoid": 0}), curve_styles({"ellipsoid": 0, "quartic": 0})
    assert one == other[::-1]
    assert curve_styles({"ellipsoid": 0})[0][2] == one[1][2]
    assert curve_styles({"ellipsoid": 0, "a": 0})[0][2] == one[0][2]  # with other names, in order


@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_save(tmp_path, suffix):
    """Save to a new folder, with the resolution and fonts of the style, also outside of its context."""
    figure, axes = plt.subplots(layout="constrained")
    axes.set_title("a curve")
    path = plot.save(figure, tmp_path / "new" / f"picture.{suffix}")
    assert {"png": b"PNG", "pdf": b"%PDF", "svg": b"<svg"}[suffix] in path.read_bytes()[:800]
    assert not plt.fignum_exists(figure.number)
    if suffix == "png":
        width = plt.imread(path).shape[1]
        assert width == pytest.approx(160 * figure.get_size_inches()[0], rel=0.1)
    if suffix == "svg":
        assert "a curve" in path.read_text()  # text is saved as text
