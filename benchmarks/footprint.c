/* Prints the number of states of a C library, the bytes of its struct, and the most bytes of stack that a step of order 8
 * and a run take: of the stack below, filled before, the part that is changed.
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#define JOINED(model, name) model##_##name
#define NAMED(model, name) JOINED(model, name)
#define PUBLIC(name) NAMED(MODEL, name)

enum { DEPTH = 1 << 20, NEAR = 256, FILLED = 0xA5 }; /* nearby is what this program itself needs */

static MODEL model;

static int step(void)
{
    return PUBLIC(step)(&model, 1e-4, 8);
}

static int simulate(void)
{
    return PUBLIC(simulate)(&model, 0.1, 1e-6, 1e-6, NULL, 0, NULL);
}

static long stack_of(int (*function)(void))
{
    volatile unsigned char here = 0;
    volatile unsigned char *const end = (volatile unsigned char *)((uintptr_t)&here - DEPTH);
    long untouched = 0;
    for (int i = DEPTH - NEAR; i > 0; --i)
        end[i - 1] = FILLED;
    if (function())
        exit(1);
    while (untouched < DEPTH - NEAR && end[untouched] == FILLED)
        ++untouched;
    return DEPTH - untouched;
}

int main(void)
{
    PUBLIC(init)(&model);
    for (int i = 0; i < PUBLIC(n_r); ++i)
        if (model.held[i])
            model.r[i] = 0.0;
    if (PUBLIC(close)(&model))
        return 2;
    printf("%d %d %ld ", (int)PUBLIC(n_x), (int)sizeof model, stack_of(step));
    printf("%ld\n", stack_of(simulate));
    return 0;
}
