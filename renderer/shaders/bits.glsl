// The field of `width` bits that begins `first_bit` bits after the word `first_word` of a stream; see storage/packed/bits.py.
// A macro, because GLSL passes no buffers to functions; the double shift keeps shifts below 32.
#ifndef READ_BITS
#define READ_BITS(words, first_word, first_bit, width)                                              \
    ((((words)[(first_word) + ((first_bit) >> 5)] >> ((first_bit) & 31u))                           \
      | (((words)[(first_word) + ((first_bit) >> 5) + 1u] << (31u - ((first_bit) & 31u))) << 1))    \
     & ((1u << (width)) - 1u))
#endif
