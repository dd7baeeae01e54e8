"""The record of a run: written as MCAP by a process of its own, read back bit for bit, summarised, plotted, replayed."""
