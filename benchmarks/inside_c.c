/* Time of one evaluation inside C. KERNEL is the kernel's name, whose header comes before this file.
 * Arguments: rhs or dynamics (forming the equations alone), N, T, the state, the parameters; prints seconds.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static double *doubles(int n)
{
    return calloc((size_t)(n + 1), sizeof(double));
}

int main(int argc, char **argv)
{
    const fb_kernel *k = &KERNEL;
    const int n_x = k->n_x;
    if (argc != 4 + n_x + k->n_p)
        return 2;
    const int forming = strcmp(argv[1], "dynamics") == 0, n = atoi(argv[2]);
    const double t = atof(argv[3]);
    double *x = doubles(n_x), *p = doubles(k->n_p), *r = doubles(k->n_r), *constants = doubles(k->n_constants);
    double *rates = doubles(n_x), *mass_matrix = doubles(k->n_u * k->n_u), *forcing = doubles(k->n_u);
    double *constraint_jacobian = doubles(k->n_c * k->n_u), *acceleration_bias = doubles(k->n_c), sum = 0.0;
    void *work = malloc(k->work_size);
    for (int i = 0; i < n_x; ++i)
        x[i] = atof(argv[4 + i]);
    for (int i = 0; i < k->n_p; ++i)
        p[i] = atof(argv[4 + n_x + i]);
    k->prepare(p, constants);
    const double begin = seconds();
    for (int i = 0; i < n; ++i) {
        /* Another time and state in each turn: nothing may move out of the loop. */
        const double shift = 1e-9 * i;
        x[0] += 1e-12;
        k->default_inputs(t + shift, constants, r);
        if (forming) {
            k->dynamics(t + shift, x, constants, r, rates, mass_matrix, forcing, constraint_jacobian,
                        acceleration_bias);
            sum += forcing[0];
        } else {
            k->rhs(t + shift, x, constants, r, rates, work);
            sum += rates[n_x - 1];
        }
    }
    const double end = seconds();
    printf("%.17g %.17g\n", (end - begin) / n, sum);
    double *all[] = {x, p, r, constants, rates, mass_matrix, forcing, constraint_jacobian, acceleration_bias};
    for (size_t i = 0; i < sizeof all / sizeof *all; ++i)
        free(all[i]);
    free(work);
    return 0;
}
