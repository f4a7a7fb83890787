/* Time of one evaluation inside C: arguments N, T, the state, the parameters; prints seconds per evaluation. */
#include "four_bar_kernel.h"

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

int main(int argc, char **argv)
{
    const fb_kernel *k = &four_bar_kernel;
    const int n_x = k->n_q + k->n_u;
    if (argc != 3 + n_x + k->n_p)
        return 2;
    const int n = atoi(argv[1]);
    const double t = atof(argv[2]);
    double *x = malloc((size_t)n_x * sizeof(double)), *rates = malloc((size_t)n_x * sizeof(double)), sum = 0.0;
    double *p = malloc((size_t)(k->n_p + 1) * sizeof(double)), *r = malloc((size_t)(k->n_r + 1) * sizeof(double));
    double *constants = malloc((size_t)k->n_constants * sizeof(double));
    void *work = malloc(k->work_size);
    for (int i = 0; i < n_x; ++i)
        x[i] = atof(argv[3 + i]);
    for (int i = 0; i < k->n_p; ++i)
        p[i] = atof(argv[3 + n_x + i]);
    k->prepare(p, constants);
    const double begin = seconds();
    for (int i = 0; i < n; ++i) {
        /* Another time and state in each turn: nothing may move out of the loop. */
        const double shift = 1e-9 * i;
        x[0] += 1e-12;
        k->default_inputs(t + shift, constants, r);
        k->rhs(t + shift, x, constants, r, rates, work);
        sum += rates[n_x - 1];
    }
    const double end = seconds();
    printf("%.17g %.17g\n", (end - begin) / n, sum);
    free(x);
    free(rates);
    free(p);
    free(r);
    free(constants);
    free(work);
    return 0;
}
