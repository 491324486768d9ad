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
    remainder: wp.float32  # what is left of the random number: uniform in [0, 1), free for another use


# Bucket and side from two uniform numbers in [0, 1): exact for tables of any size,
# because float32 keeps no bits of u once it has picked one of many buckets. The remainder is v's.
@wp.func
def alias_choice(buckets: wp.array(dtype=AliasBucket), count: wp.int32, u: wp.float32, v: wp.float32) -> AliasChoice:
    item = wp.min(wp.int32(u * wp.float32(count)), count - 1)
    bucket = buckets[item]
    keep = bucket.probability
    choice = AliasChoice()
    if v < keep:
        choice.item = item
        choice.pdf = bucket.pdf
        choice.remainder = v / keep
    else:
        choice.item = bucket.index
        choice.pdf = bucket.index_pdf
        choice.remainder = (v - keep) / (1.0 - keep)
    choice.remainder = wp.min(choice.remainder, LARGEST_FLOAT_BELOW_ONE)
    return choice


# The same from one number, which keeps its stratification. Of u's 24 bits, log2(count) pick the
# bucket: for tables of up to a few thousand items.
@wp.func
def alias_choice_small(buckets: wp.array(dtype=AliasBucket), count: wp.int32, u: wp.float32) -> AliasChoice:
    scaled = u * wp.float32(count)
    return alias_choice(buckets, count, u, scaled - wp.floor(scaled))


# Starts fetching the bucket that alias_choice will read for u.
@wp.func_native(
    snippet="""
#if !defined(__CUDA_ARCH__)
    const int bucket = (int)(u * (float)count);
    __builtin_prefetch(&buckets.data[bucket < count ? bucket : count - 1]);
#endif
"""
)
def alias_prefetch(buckets: wp.array(dtype=AliasBucket), count: wp.int32, u: wp.float32): ...
