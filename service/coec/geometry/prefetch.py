"""Prefetching of memory from compiled loops."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

_READ, _SECOND_LEVEL, _DATA = 0, 2, 1
"""Arguments of LLVM's `prefetch`: for reading; keep in the second-level cache and below; data, not code."""

_SIGNATURE = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, *[cgutils.int32_t] * 3])


@intrinsic
def _prefetch(context: Any, array: types.Array, index: types.Integer) -> tuple[Any, Any]:  # noqa: ARG001
    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        values = context.make_array(signature.args[0])(context, builder, arguments[0])
        entry = cgutils.get_item_pointer(context, builder, signature.args[0], values, [arguments[1]])
        function = builder.module.declare_intrinsic("llvm.prefetch", [cgutils.voidptr_t], _SIGNATURE)
        options = [cgutils.int32_t(option) for option in (_READ, _SECOND_LEVEL, _DATA)]
        builder.call(function, [builder.bitcast(entry, cgutils.voidptr_t), *options])
        return context.get_dummy_value()

    return types.void(array, index), generate


prefetch = cast("Callable[[NDArray[Any], np.integer], None]", _prefetch)
"""`prefetch(array, index)` begins to fetch the cache line of an entry of an array (n,). It does not wait, and an index
outside of the array does no harm."""
