"""Measuring: errors, bias and speed of renders, references, sweeps and what they show.

Needs the extra ``[measure]``. Nothing but the commands import it (see `cli.measuring`).

* What is measured: `metrics` (errors, colour differences), `agreement` (bias), `efficiency`, `timing`.
* What of: `project` (the user's folder), `scenes` (any scene file, at any size).
* Against what: `reference` (stored ones), `making` and `halves` (how they come about).
* Sweeps: `preset` (what is rendered), `cells`, `bench` (renders), `rows` (what is kept), `sweep`, `probes`.
* What they show: `analysis` (figures with their reasons), `tables`, `figures`, `report`, `page`.
* Two or a few ways to render: `compare`, `equal_time`.
* Single strategies and paths: `pyramid`; `fireflies` with `recording`, `reconstruct`, `oracle`, `endpoints`.
* What a terminal shows meanwhile: `showing`.
* Kernels: `floor`.
"""
