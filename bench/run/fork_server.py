"""The server that runs' processes branch off from: it has imported what is slow, once for all of them."""

import multiprocessing
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from pkgutil import iter_modules

import bench.tasks
import datasets


def start() -> ForkServerContext:
    """Starts the server unless it runs, and gives the context of its processes; it imports while the caller goes on."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(preloaded())
    forkserver.ensure_running()
    return context


def preloaded() -> list[str]:
    """Modules that are slow to import and that runs need."""
    packages = bench.tasks, datasets
    named = [module.name for one in packages for module in iter_modules(one.__path__, f"{one.__name__}.")]
    return ["bench", "open3d", "bench.run.execute", *named]  # bench first: it sets what torch reads at its import
