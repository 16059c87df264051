/* The numbers and the vectors of all programs here: a V is as wide as the widest register there is. */
#ifndef REAL
#define REAL double
#endif
#ifndef BYTES /* of a V: the widest register there is; two to a V were slower */
#if defined(__AVX512F__)
#define BYTES 64
#elif defined(__AVX__)
#define BYTES 32
#else
#define BYTES 16
#endif
#endif
#define INLINE static inline __attribute__((always_inline))

typedef REAL V __attribute__((vector_size(BYTES)));
