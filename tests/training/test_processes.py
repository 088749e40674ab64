"""Two processes that share a batch take the same step as one that has it all."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.model.conftest import SMALL
from utopic_cli.bridge import cpu_threads
from utopic_cli.config import ModelConfig
from utopic_cli.errors import InputError
from utopic_cli.synthesis.pairs import PairSettings
from utopic_cli.synthesis.shapes import procedural_shapes
from utopic_cli.training.data import Batch, SynthesisedPairs
from utopic_cli.training.network import LossWeights, TrainingNetwork, total_loss
from utopic_cli.training.processes import Processes, joined_processes

ROOT = Path(__file__).resolve().parents[2]
WEIGHTS = LossWeights(0.5, 1.0, 0.5, 1.0, 0.0, 0.0, 0.1)  # without the two losses that draw at random


def gradients(share: tuple[int, int], processes: Processes, stage: str) -> dict[str, torch.Tensor]:
    """Gradients of a fixed network on one process' share of a batch of four pairs."""
    rank, count = share
    pairs = SynthesisedPairs(procedural_shapes(np.random.default_rng(0), 4, 32), PairSettings(), 1, 6)
    batch = pairs[Batch(rank * 4 // count, 4 // count, 60, 60)]
    torch.manual_seed(0)
    network = TrainingNetwork(ModelConfig(**{**SMALL, "uncertainty_scheme": "predicted"}))
    if stage == "descriptor":
        loss = network.descriptor_stage(batch)["descriptor"]
    else:
        generator = torch.Generator().manual_seed(0)
        loss = total_loss(network.joint_stage(batch, generator, masking=False, completion=True), WEIGHTS)
    loss.backward()
    processes.average_gradients(network.parameters())
    return {name: p.grad for name, p in network.named_parameters() if p.grad is not None}


def _share(stage: str, out: str) -> None:
    """What each of the two processes runs."""
    with joined_processes(torch.device("cpu")) as processes:
        found = gradients((processes.rank, processes.count), processes, stage)
        stopped = processes.any_of(processes.rank == 1, torch.device("cpu"))
        torch.save({"gradients": found, "stopped": stopped}, f"{out}/{processes.rank}.pt")


def start_two(arguments: list[str]) -> list[subprocess.CompletedProcess[str]]:
    """Start a command twice, as torchrun does, and wait for both."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    common = {**os.environ, "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    common["OMP_NUM_THREADS"] = "1"
    running = [
        subprocess.Popen(
            [sys.executable, *arguments],
            cwd=ROOT,
            env={**common, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    done = []
    for process in running:
        out, err = process.communicate(timeout=120)
        done.append(subprocess.CompletedProcess(arguments, process.returncode, out, err))
    return done


@pytest.mark.parametrize("stage", ["descriptor", "joint"])
def test_gradients_of_two_processes_agree_with_those_of_one(tmp_path, stage):
    code = f"from tests.training.test_processes import _share; _share({stage!r}, {str(tmp_path)!r})"
    for done in start_two(["-c", code]):
        assert done.returncode == 0, done.stderr
    with cpu_threads(1):  # as the two have: the order of sums is a matter of threads
        alone = gradients((0, 1), Processes(), stage)
    for rank in range(2):
        answer = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        assert answer["stopped"]  # one process' wish to stop is everybody's
        assert all(not grad.any() for name, grad in answer["gradients"].items() if name not in alone)
        for name, gradient in alone.items():
            # By norm: single float32 entries hang on which of two nearly equal maxima is the larger.
            difference = (answer["gradients"][name] - gradient).norm()
            assert difference < 2e-3 * gradient.norm() + 1e-5, name


def test_the_command_trains_in_two_processes(tmp_path):
    config = tmp_path / "tiny.toml"
    model = "\n".join(f"{name} = {list(v) if isinstance(v, tuple) else v}" for name, v in SMALL.items())
    schedule = "descriptor_pairs = 4\njoint_pairs = 4\npoints = [60, 80]\nlast_points = [60, 80]"
    config.write_text(f"[model]\n{model}\n[schedule]\n{schedule}\nvalidation_pairs = 1\n")
    command = ["-m", "utopic_cli", "train", "--config", str(config), "--out", str(tmp_path / "run")]
    first, second = start_two([*command, "--device", "cpu"])
    assert first.returncode == 0, first.stderr
    assert second.returncode == 0, second.stderr
    records = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert records[-1]["pairs"] == 8
    assert (tmp_path / "run" / "utopic.safetensors").is_file()


def test_a_batch_that_cannot_be_shared_is_refused(monkeypatch, tmp_path):
    from utopic_cli.training import trainer
    from utopic_cli.training.config import TrainingConfig

    class Three:
        def __enter__(self):
            return Processes(0, 3)

        def __exit__(self, *_):
            return None

    monkeypatch.setattr(trainer, "joined_processes", lambda _: Three())
    with pytest.raises(InputError, match="batch 2 can't be shared by 3 processes"):
        trainer.train(TrainingConfig(), None, None, tmp_path)  # type: ignore[arg-type]
