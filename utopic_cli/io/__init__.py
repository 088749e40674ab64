"""Scan files in, results out: strict readers, re-emission of whole files, atomic writing."""
