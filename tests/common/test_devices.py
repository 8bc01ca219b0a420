"""Which device is picked, and what is said where there is none."""

from __future__ import annotations

import pytest
import torch

from flowsplat.common import devices, progress
from flowsplat.common.errors import InputError


@pytest.fixture
def without_gpu(monkeypatch):
    monkeypatch.setattr(devices, "gpu_problem", lambda: "nobody plugged it in")
    progress.forget_reported()


@pytest.fixture
def with_gpu(monkeypatch):
    monkeypatch.setattr(devices, "gpu_problem", lambda: None)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "A card")


def test_auto_goes_on_with_the_cpu_and_says_why_once(without_gpu, capsys):
    for _ in range(3):
        assert devices.pick_device("auto") == torch.device("cpu")
    assert capsys.readouterr().err == "Computing on the CPU: nobody plugged it in.\n"
    assert devices.pick_device("cpu") == torch.device("cpu")
    assert capsys.readouterr().err == ""


def test_what_does_not_work_is_refused(without_gpu):
    with pytest.raises(InputError, match=r"--device cuda does not work here: nobody plugged it in"):
        devices.pick_device("cuda")
    with pytest.raises(InputError, match="Unknown device 'tpu'"):
        devices.pick_device("tpu")


def test_auto_picks_a_gpu_that_works(with_gpu):
    assert devices.pick_device("auto") == devices.pick_device("cuda") == torch.device("cuda")
    assert devices.pick_device("cpu") == torch.device("cpu")


def test_both_backends_are_shown_with_their_reasons(without_gpu):
    cpu, gpu = devices.backends()
    assert (cpu.name, cpu.works) == ("cpu", True)
    assert (gpu.name, gpu.works, gpu.reason) == ("cuda", False, "nobody plugged it in")


def test_the_card_is_named(with_gpu):
    assert devices.backends()[1] == devices.Backend("cuda", True, "Triton on A card")


def test_float32_has_kernels_and_the_rest_goes_through_the_oracles():
    assert devices.kernels_for(torch.zeros(1)) == "cpu"
    assert devices.kernels_for(torch.zeros(1, dtype=torch.float64)) == "reference"
    assert devices.kernels_for(torch.zeros(1, device="meta")) == "reference"


def test_on_the_cpu_nothing_is_copied():
    values = torch.arange(3)
    assert devices.upload(values, torch.device("cpu")) is values
    array = values.numpy()
    assert devices.upload(array, torch.device("cpu")).data_ptr() == values.data_ptr()
