"""Seeded workloads, with time and error against the f64 reference."""

from __future__ import annotations

from igsr_lab.bench.accuracy import measure_accuracy, write_accuracy
from igsr_lab.bench.gpu_report import device_report, json_beside, write_device_report
from igsr_lab.bench.gpu_session import run_session
from igsr_lab.bench.kernel_times import kernel_tables, print_kernels
from igsr_lab.bench.plots import plot_speed_vs_error
from igsr_lab.bench.run import WORKLOADS, Settings, resolved_backends, run_benchmark
from igsr_lab.bench.table import print_pairs, print_report
from igsr_lab.bench.two_builds import compare_builds, slower_rows

__all__ = [
    "WORKLOADS",
    "Settings",
    "compare_builds",
    "device_report",
    "json_beside",
    "kernel_tables",
    "measure_accuracy",
    "plot_speed_vs_error",
    "print_kernels",
    "print_pairs",
    "print_report",
    "resolved_backends",
    "run_benchmark",
    "run_session",
    "slower_rows",
    "write_accuracy",
    "write_device_report",
]
