"""The log density with its gradient by reverse mode, which nothing in the library needs and everybody may take."""

from __future__ import annotations

import jax

from tvsbayes.estimators.likelihood import log_density

value_and_gradient = jax.jit(jax.value_and_grad(log_density))
"""(z, space, arrays) -> log posterior density and its gradient by the coordinates; float64 has to be on."""
