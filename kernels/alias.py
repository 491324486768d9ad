"""Selecting from a discrete distribution in constant time by an alias table.

Tables come from ``warp_gi.alias.AliasTable``.
"""

import warp as wp

from warp_gi.kernels.types import AliasBucket

wp.set_module_options({"enable_backward": False})

LARGEST_FLOAT_BELOW_ONE = wp.constant(wp.float32(0.99999994))


@wp.struct
class AliasChoice:
    item: wp.int32
    pdf: wp.float32  # probability of selecting it
    remainder: wp.float32  # what is left of the random numbers: uniform in [0, 1), free for another use


# Where two uniform numbers in [0, 1) fall among `count` buckets: the whole part is the bucket, the rest uniform
# in it. A float32 holds 24 bits, too few for a table of millions, so the digits of v follow those of u.
@wp.func
def alias_position(count: wp.int32, u: wp.float32, v: wp.float32) -> wp.float64:
    return (wp.float64(u) + wp.float64(v) * wp.float64(5.9604644775390625e-8)) * wp.float64(count)


# An item of a table that has `count` buckets of many from number `start` on, from two uniform numbers in [0, 1): u
# decides, as stratified as it is, and v adds digits (alias_position).
@wp.func
def alias_choice_of(
    buckets: wp.array(dtype=AliasBucket), start: wp.int32, count: wp.int32, u: wp.float32, v: wp.float32
) -> AliasChoice:
    position = alias_position(count, u, v)
    item = wp.min(wp.int32(position), count - 1)
    rest = wp.min(wp.float32(position - wp.float64(item)), LARGEST_FLOAT_BELOW_ONE)
    bucket = buckets[start + item]
    keep = bucket.probability
    choice = AliasChoice()
    if rest < keep:
        choice.item = item
        choice.pdf = bucket.pdf
        choice.remainder = rest / keep
    else:
        choice.item = bucket.index
        choice.pdf = bucket.index_pdf
        choice.remainder = (rest - keep) / (1.0 - keep)
    choice.remainder = wp.min(choice.remainder, LARGEST_FLOAT_BELOW_ONE)
    return choice


# An item of a table by itself.
@wp.func
def alias_choice(buckets: wp.array(dtype=AliasBucket), count: wp.int32, u: wp.float32, v: wp.float32) -> AliasChoice:
    return alias_choice_of(buckets, 0, count, u, v)


# Starts fetching the bucket that alias_choice will read for u (or, in tables of millions, its neighbour).
@wp.func_native(
    snippet="""
#if !defined(__CUDA_ARCH__)
    const int bucket = (int)(u * (float)count);
    __builtin_prefetch(&buckets.data[bucket < count ? bucket : count - 1]);
#endif
"""
)
def alias_prefetch(buckets: wp.array(dtype=AliasBucket), count: wp.int32, u: wp.float32): ...
