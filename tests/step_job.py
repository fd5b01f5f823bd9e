"""Images and gradients of a training step, computed in a process with a backend and a number of threads of its own.

``python step_job.py FOLDER FILE BACKEND`` takes a data set and stores the arrays in ``FILE`` (npz).
"""

import os
import subprocess
import sys

import numpy as np

from wrf_mi.backend import init
from wrf_mi.backend.libraries import LLVM_VARIABLE

STEP = ("initial.gaussians=8", "batch=4")


def step_in_process(folder, out, backend="llvm", llvm=None):
    """Images ``image`` and gradients by parameter of the first step, with another LLVM library where one is given."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(part for part in sys.path if part)}
    if llvm is not None:
        environment[LLVM_VARIABLE] = str(llvm)
    subprocess.run([sys.executable, __file__, str(folder), str(out), backend], check=True, env=environment)
    with np.load(out) as arrays:
        return dict(arrays)


def main(folder, out, backend):
    """Compute the step at the initial parameters, on one thread."""
    init(backend, 1)
    import drjit as dr
    import mitsuba as mi
    from small_fits import official, settings

    from wrf_mi.backend.device import to_float, to_tensor
    from wrf_mi.datasets import load
    from wrf_mi.gaussians.tiles import perception_plane
    from wrf_mi.graph.graph import Batch
    from wrf_mi.tasks.losses import spectrum_loss
    from wrf_mi.training.step import TrainingData, device_pose
    from wrf_mi.training.trainer import Trainer

    record = load(folder)
    trainer = Trainer(record, official(record), settings(*STEP))
    params = {name: to_tensor(values) for name, values in trainer.state.params().items()}
    plane, pose = perception_plane(*record.observation.shape[-2:], mi.Float), device_pose(record.receivers[0])
    data = TrainingData(to_tensor(record.tx_pos_m.T), to_float(record.observation), to_float([1.0]))
    dr.enable_grad(params)
    batch = trainer.config.batch
    tx, truth, _ = data.select(mi.UInt32(trainer.plan.split.train[:batch].tolist()), mi.UInt32(0), plane.pixels)
    image = trainer.graph.observation(0, None)(params, Batch(tx, None, None, pose, plane))
    dr.backward(spectrum_loss(image, truth, batch, plane.height, plane.width, trainer.config.loss.ssim_weight)[0])
    gradients = {name: dr.grad(value).numpy() for name, value in params.items()}
    np.savez(out, image=dr.detach(image).numpy(), **gradients)


if __name__ == "__main__":
    main(*sys.argv[1:])
