"""Checksums of host memory, from which edits of a scene's arrays are found."""

import warp as wp

wp.set_module_options({"enable_backward": False})


# A part of an array in host memory.
@wp.struct
class MemoryChunk:
    address: wp.uint64
    size: wp.int32  # bytes


# Checksum of `size` bytes from `address`; host memory, so CUDA does not read it. Every step is invertible, so another
# word alone is always another checksum. Four chains, since a multiplication takes longer than a load.
@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return 0;
#else
    typedef unsigned int Lanes __attribute__((vector_size(32)));
    typedef unsigned int LooseLanes __attribute__((vector_size(32), aligned(1), may_alias));
    const unsigned char* bytes = reinterpret_cast<const unsigned char*>(address);
    const LooseLanes* words = reinterpret_cast<const LooseLanes*>(bytes);
    const Lanes start = {1, 2, 3, 4, 5, 6, 7, 8};
    Lanes chains[8];
    for (int k = 0; k < 8; ++k) chains[k] = start + 8 * k;
    int done = 0;
    for (; done + 256 <= size; done += 256, words += 8)
        for (int k = 0; k < 8; ++k) chains[k] = (chains[k] ^ words[k]) * 0x9e3779b1u;
    unsigned long long sum = size;
    auto add = [&sum](unsigned long long word) { sum = (sum ^ (sum >> 32) ^ word) * 0x9e3779b97f4a7c15ull; };
    for (; done < size; ++done) add(bytes[done]);
    for (int k = 0; k < 8; ++k)
        for (int lane = 0; lane < 8; ++lane) add(chains[k][lane]);
    return sum ^ (sum >> 32);
#endif
"""
)
def checksum(address: wp.uint64, size: wp.int32) -> wp.uint64: ...


# Thread: a chunk.
@wp.kernel
def sum_chunks(first: wp.int32, chunks: wp.array(dtype=MemoryChunk), sums: wp.array(dtype=wp.uint64)):
    item = first + wp.tid()
    sums[item] = checksum(chunks[item].address, chunks[item].size)
