"""Output for people: single pictures, the overview, the page ``report.html`` and the record of a registration."""

from torchdeform.report.page import write_report
from torchdeform.report.plots import (
    plot_checkerboard,
    plot_convergence,
    plot_curl,
    plot_determinant,
    plot_difference,
    plot_divergence,
    plot_grid,
    plot_image,
    plot_inverse_error,
    plot_overlay,
    plot_volume_histogram,
)
from torchdeform.report.report_data import ReportData, make_report_data

__all__ = [
    "ReportData",
    "make_report_data",
    "plot_checkerboard",
    "plot_convergence",
    "plot_curl",
    "plot_determinant",
    "plot_difference",
    "plot_divergence",
    "plot_grid",
    "plot_image",
    "plot_inverse_error",
    "plot_overlay",
    "plot_volume_histogram",
    "write_report",
]
