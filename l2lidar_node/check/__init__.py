"""Judges whether clouds and IMU samples are what a certain consumer can work with.

Pure: what was received goes in as plain values (:mod:`.observation`), findings come out
(:mod:`.verdict`). What each consumer demands is a table (:mod:`.consumers`).
"""
