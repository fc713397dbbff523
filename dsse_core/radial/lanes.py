"""Numbers of several rows side by side, for code compiled with numba: code for one row computes LANES rows at once.

Compiled for arrays of ``lanes`` in place of floats, code uses the vector arithmetic of the processor. It does not rely
on the compiler to vectorise by itself. A comparison holds where it holds in every lane.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import impl_ret_borrowed
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import (
    intrinsic,
    lower_builtin,
    lower_cast,
    make_attribute_wrapper,
    models,
    overload_method,
    register_model,
)
from numba.np.arrayobj import make_array, populate_array

LANES = 8  # of 64 bits: a vector of AVX-512, two of AVX
_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_INDEX = ir.IntType(32)


class _Lanes(types.Type):
    def __init__(self) -> None:
        super().__init__("lanes")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        return Conversion.promote if isinstance(other, types.Integer | types.Float) else None


class _ComplexLanes(types.Type):
    def __init__(self) -> None:
        super().__init__("complex_lanes")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        return Conversion.promote if isinstance(other, types.Complex) else None


lanes, complex_lanes = _Lanes(), _ComplexLanes()


@register_model(_Lanes)
class _Vector(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


@register_model(_ComplexLanes)
class _TwoVectors(models.StructModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, [("real", lanes), ("imag", lanes)])


make_attribute_wrapper(_ComplexLanes, "real", "real")
make_attribute_wrapper(_ComplexLanes, "imag", "imag")


def _repeat(builder: Any, number: Any) -> Any:
    """The vector with ``number`` in every lane."""
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), number, ir.Constant(_INDEX, 0))
    of_first = ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES)
    return builder.shuffle_vector(one, ir.Constant(_VECTOR, ir.Undefined), of_first)


@lower_cast(types.Number, lanes)
def _spread(context: Any, builder: Any, fromty: Any, toty: Any, number: Any) -> Any:
    return _repeat(builder, context.cast(builder, number, fromty, types.float64))


@lower_cast(types.Complex, complex_lanes)
def _spread_complex(context: Any, builder: Any, fromty: Any, toty: Any, number: Any) -> Any:
    given = context.make_complex(builder, fromty, number)
    return _pair(context, builder, _repeat(builder, given.real), _repeat(builder, given.imag))


def _pair(context: Any, builder: Any, real: Any, imag: Any) -> Any:
    pair = cgutils.create_struct_proxy(complex_lanes)(context, builder)
    pair.real, pair.imag = real, imag
    return pair._getvalue()


def _define(function: Any, returns: Any, takes: tuple[Any, ...], emit: Callable[..., Any]) -> None:
    """Makes compiled code call ``emit(context, builder, *args)`` for ``function`` where an argument is of lanes."""

    class Typed(AbstractTemplate):
        key = function

        def generic(self, args: Any, kws: Any) -> Any:
            has_lanes = any(isinstance(arg, _Lanes | _ComplexLanes) for arg in args)
            fit = len(args) == len(takes) and all(map(self.context.can_convert, args, takes))
            return signature(returns, *takes) if has_lanes and fit else None

    infer_global(function)(Typed)
    lower_builtin(function, *takes)(lambda context, builder, _, args: emit(context, builder, *args))


def _call(name: str) -> Callable[..., Any]:
    """An intrinsic function of LLVM, lane by lane."""

    def emit(_: Any, builder: Any, *args: Any) -> Any:
        takes = ir.FunctionType(_VECTOR, [_VECTOR] * len(args))
        function = cgutils.get_or_insert_function(builder.module, takes, f"llvm.{name}.v{LANES}f64")
        return builder.call(function, args)

    return emit


def _all(sign: str) -> Callable[..., Any]:
    def emit(_: Any, builder: Any, a: Any, b: Any) -> Any:
        return _everywhere(builder, builder.fcmp_ordered(sign, a, b))

    return emit


def _everywhere(builder: Any, holds: Any) -> Any:
    mask = builder.bitcast(holds, ir.IntType(LANES))
    return builder.icmp_unsigned("==", mask, ir.Constant(mask.type, -1))


def _is_finite(_: Any, builder: Any, a: Any) -> Any:
    return _everywhere(builder, builder.fcmp_ordered("==", builder.fsub(a, a), ir.Constant(_VECTOR, [0.0] * LANES)))


def _larger(_: Any, builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def _remainder(context: Any, builder: Any, a: Any, b: Any) -> Any:
    return builder.fsub(a, builder.fmul(b, _call("floor")(context, builder, builder.fdiv(a, b))))


def _square(_: Any, builder: Any, a: Any, power: Any) -> Any:
    """The square, the only power in the kernel."""
    return builder.fmul(a, a)


def _add_complex(context: Any, builder: Any, a: Any, b: Any) -> Any:
    (ar, ai), (br, bi) = (cgutils.unpack_tuple(builder, part, 2) for part in (a, b))
    return _pair(context, builder, builder.fadd(ar, br), builder.fadd(ai, bi))


def _multiply_complex(context: Any, builder: Any, a: Any, b: Any) -> Any:
    (ar, ai), (br, bi) = (cgutils.unpack_tuple(builder, part, 2) for part in (a, b))
    real = builder.fsub(builder.fmul(ar, br), builder.fmul(ai, bi))
    return _pair(context, builder, real, builder.fadd(builder.fmul(ar, bi), builder.fmul(ai, br)))


_TWO, _TWO_COMPLEX = (lanes, lanes), (complex_lanes, complex_lanes)
_define(operator.add, lanes, _TWO, lambda _, builder, a, b: builder.fadd(a, b))
_define(operator.iadd, lanes, _TWO, lambda _, builder, a, b: builder.fadd(a, b))
_define(operator.sub, lanes, _TWO, lambda _, builder, a, b: builder.fsub(a, b))
_define(operator.isub, lanes, _TWO, lambda _, builder, a, b: builder.fsub(a, b))
_define(operator.mul, lanes, _TWO, lambda _, builder, a, b: builder.fmul(a, b))
_define(operator.truediv, lanes, _TWO, lambda _, builder, a, b: builder.fdiv(a, b))
_define(operator.mod, lanes, _TWO, _remainder)
_define(operator.pow, lanes, (lanes, types.int64), _square)
_define(operator.neg, lanes, (lanes,), lambda _, builder, a: builder.fneg(a))
_define(operator.lt, types.boolean, _TWO, _all("<"))
_define(operator.le, types.boolean, _TWO, _all("<="))
_define(operator.gt, types.boolean, _TWO, _all(">"))
_define(operator.ge, types.boolean, _TWO, _all(">="))
_define(max, lanes, _TWO, _larger)
_define(abs, lanes, (lanes,), _call("fabs"))
_define(math.sqrt, lanes, (lanes,), _call("sqrt"))
_define(math.sin, lanes, (lanes,), _call("sin"))
_define(math.cos, lanes, (lanes,), _call("cos"))
_define(math.isfinite, types.boolean, (lanes,), _is_finite)
_define(complex, complex_lanes, _TWO, _pair)
_define(operator.add, complex_lanes, _TWO_COMPLEX, _add_complex)
_define(operator.iadd, complex_lanes, _TWO_COMPLEX, _add_complex)
_define(operator.mul, complex_lanes, _TWO_COMPLEX, _multiply_complex)


@overload_method(_ComplexLanes, "conjugate")
def _conjugate(c):
    return lambda c: complex(c.real, -c.imag)


def _view(dtype: Any, lost: int) -> Any:
    """A function that views an array as one of ``dtype``, whose last ``lost`` dimensions are in each number."""

    def view(typingctx: Any, array: Any) -> Any:
        found = types.Array(dtype, array.ndim - lost, "C", aligned=False)

        def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            given, result = make_array(array)(context, builder, args[0]), make_array(found)(context, builder)
            shape, strides = (cgutils.unpack_tuple(builder, part) for part in (given.shape, given.strides))
            size = context.get_abi_sizeof(context.get_data_type(dtype))
            populate_array(
                result,
                data=builder.bitcast(given.data, result.data.type),
                shape=shape[: found.ndim] + [context.get_constant(types.intp, LANES)] * -lost,
                strides=strides[: found.ndim] + [context.get_constant(types.intp, size)] * -lost,
                itemsize=context.get_constant(types.intp, size),
                meminfo=given.meminfo,
            )
            return impl_ret_borrowed(context, builder, found, result._getvalue())

        return signature(found, array), emit

    return intrinsic(view)


as_lanes = _view(lanes, 1)
"""A view of floats (..., LANES) as ``lanes`` (...)."""
as_complex_lanes = _view(complex_lanes, 2)
"""A view of floats (..., 2, LANES), real and imaginary parts, as ``complex_lanes`` (...)."""
as_floats = _view(types.float64, -1)
"""A view of ``lanes`` (...) as floats (..., LANES)."""
