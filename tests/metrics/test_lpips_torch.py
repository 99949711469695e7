"""LPIPS beside the same network in PyTorch, written down from the layers of torchvision's models; random weights."""

import numpy as np
import pytest

from minisplat_ref.metrics.lpips import load_network, lpips
from tolerances import LPIPS_FLOAT32, PARITY_FLOAT64

torch = pytest.importorskip("torch", reason="the extra minisplat_ref[peers] is not installed")
from torch import nn  # noqa: E402  (after the line that skips without it)

HEIGHT, WIDTH = 41, 52  # odd, so that windows do not fill the image


def conv(n_in, n_out, size=3, stride=1, padding=1):
    return nn.Conv2d(n_in, n_out, size, stride, padding)


def alexnet_layers():
    """Features of AlexNet, and where the slices end."""
    layers = [conv(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), conv(64, 192, 5, 1, 2), nn.ReLU()]
    layers += [nn.MaxPool2d(3, 2), conv(192, 384), nn.ReLU(), conv(384, 256), nn.ReLU(), conv(256, 256), nn.ReLU()]
    return layers, (2, 5, 8, 10, 12), (64, 192, 384, 256, 256)


def vgg16_layers():
    layers, n_in = [], 3
    for n_out in (64, 64, None, 128, 128, None, 256, 256, 256, None, 512, 512, 512, None, 512, 512, 512):
        if n_out is None:
            layers.append(nn.MaxPool2d(2, 2))
        else:
            layers += [conv(n_in, n_out), nn.ReLU()]
            n_in = n_out
    return layers, (4, 9, 16, 23, 30), (64, 128, 256, 512, 512)


class Lpips(nn.Module):
    """With the names that the package lpips gives to its parameters."""

    def __init__(self, layers, ends, channels):
        super().__init__()
        self.shift = torch.tensor([-0.030, -0.088, -0.188], dtype=torch.float64)[:, None, None]
        self.scale = torch.tensor([0.458, 0.448, 0.450], dtype=torch.float64)[:, None, None]
        self.net, start = nn.Module(), 0
        for i, end in enumerate(ends, start=1):
            block = nn.Sequential()
            for j in range(start, end):
                block.add_module(str(j), layers[j])
            self.net.add_module(f"slice{i}", block)
            start = end
        self.lins = nn.ModuleList()
        for i, n in enumerate(channels):
            head = nn.Module()
            head.model = nn.Sequential(nn.Dropout(), nn.Conv2d(n, 1, 1, bias=False))
            nn.init.uniform_(head.model[1].weight, 0.0, 1.0 / n)
            self.add_module(f"lin{i}", head)
            self.lins.append(head)

    def forward(self, image, target, normalize=True):
        """Of images in [0, 1], which ``normalize`` takes to [-1, 1], as the package's flag of this name does."""
        x, y = (((2 * a - 1 if normalize else a) - self.shift.to(a)) / self.scale.to(a) for a in (image, target))
        total = 0.0
        for block, head in zip(self.net.children(), self.lins, strict=True):
            x, y = block(x), block(y)
            units = [a / (a.square().sum(dim=1, keepdim=True).sqrt() + 1e-10) for a in (x, y)]
            total = total + head.model((units[0] - units[1]).square()).mean()
        return float(total)


@pytest.fixture(scope="module", params=[alexnet_layers, vgg16_layers], ids=["AlexNet", "VGG16"])
def model(request):
    torch.manual_seed(5)
    with torch.no_grad():
        yield Lpips(*request.param()).eval()


@pytest.fixture
def network(model, tmp_path):
    """By the line that the help shows: the state dict as it is, tensors and all."""
    np.savez(tmp_path / "weights.npz", **model.float().state_dict())
    return load_network(tmp_path / "weights.npz")


@pytest.fixture
def pair(rng):
    target = rng.random((HEIGHT, WIDTH, 3))
    return np.clip(target + 0.2 * rng.normal(size=target.shape), 0, 1), target


def to_torch(image):
    return torch.tensor(np.moveaxis(image, 2, 0)[None])


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(np.float64, PARITY_FLOAT64), (np.float32, LPIPS_FLOAT32)], ids=["float64", "float32"]
)
def test_agrees(model, network, pair, dtype, tolerance):
    image, target = (a.astype(dtype) for a in pair)
    model = model.double() if dtype == np.float64 else model.float()
    expected = model(to_torch(image), to_torch(target))
    assert expected > 1e-4
    assert lpips(image, target, network) == pytest.approx(expected, rel=tolerance, abs=0)


def test_figures_of_3dgs(model, network, pair):
    """Its evaluation does not double the colours; half way to white, they are what they were after doubling."""
    image, target = pair
    expected = model.double()(to_torch(image), to_torch(target), normalize=False)
    assert lpips((1 + image) / 2, (1 + target) / 2, network) == pytest.approx(expected, rel=PARITY_FLOAT64, abs=0)
    assert lpips(image, target, network) != pytest.approx(expected, rel=0.1)
