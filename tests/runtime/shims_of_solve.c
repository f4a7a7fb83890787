/* The solution of M u' = f + J^T lambda, J u' + gamma = 0, for sizes and tables that are defined on the command line.
 *
 * Dense by default. With FB_SPARSE, M and J are the entries that the tables name. With FB_RECURSIVE, products with M
 * and its inverse, which generated functions would form by recursion, are those with given matrices.
 */
#include <math.h>

#include "fourbar_array.h"
#include "fourbar_real.h"

enum { N_U = SPEEDS, N_C = CONSTRAINTS, N_RANK = RANK };

#if !defined(FB_SPARSE) || defined(FB_EARLY)
static const int static_pivot_row[] = {PIVOT_ROWS}, static_pivot_speed[] = {PIVOT_SPEEDS};
#endif

#if defined(FB_SPARSE)
static const int mass_row[] = {MASS_ROW}, mass_column[] = {MASS_COLUMN};
static const int jacobian_row[] = {JACOBIAN_ROW}, jacobian_column[] = {JACOBIAN_COLUMN};
static const int unknown[] = {UNKNOWN}, column[] = {COLUMN}, below[] = {BELOW};
static const int mass_place[] = {MASS_PLACE}, jacobian_place[] = {JACOBIAN_PLACE}, pair_place[] = {PAIR_PLACE};
static const int target[] = {TARGET};
enum {
    N_MASS = sizeof mass_row / sizeof *mass_row,
    N_JACOBIAN = sizeof jacobian_column / sizeof *jacobian_column,
    N_BELOW = sizeof below / sizeof *below
};
#include "fourbar_sparse.h"

#elif defined(FB_RECURSIVE)
/* The pivots, then the inverse and M itself. */
enum { N_MASS = N_U + 2 * N_U * N_U };

#define PRODUCT(name, type, matrix)                                                                                    \
    static void name(const double *constants, const double *factors, const type *given, type *product)                 \
    {                                                                                                                  \
        (void)constants;                                                                                               \
        for (int i = 0; i < N_U; ++i) {                                                                                \
            product[i] = (type){0.0};                                                                                  \
            for (int j = 0; j < N_U; ++j)                                                                              \
                product[i] += factors[matrix * N_U * N_U + i * N_U + j] * given[j];                                    \
        }                                                                                                              \
    }
PRODUCT(mass_solve, double, 0)
PRODUCT(mass_solve_many, fb_many, 0)
PRODUCT(mass_product, fb_many, 1)
#include "fourbar_recursive.h"

#else
#include "fourbar_solve.h"
#endif

/* A status: of the factorization, or of the solution, for f, gamma and the size of gamma's terms. */
int solve(const double *mass, const double *jacobian, const double *forcing, const double *bias, double terms,
          double *accelerations, double *multipliers, int *kind, double *left)
{
    static fb_factors factors; /* large */
    factors = (fb_factors){0};
    int status = fb_factor(mass, jacobian, forcing, &factors);
#if defined(FB_RECURSIVE) || (defined(FB_SPARSE) && defined(FB_EARLY))
    *kind = factors.is_dense;
#elif defined(FB_SPARSE)
    *kind = 0;
#else
    *kind = factors.is_static;
    *left = factors.left;
    factors.terms = terms;
#endif
    (void)terms, (void)left;
    if (status == FB_OK)
        status = fb_solve_first(forcing, bias, &factors, accelerations);
    if (status == FB_OK)
        fb_multipliers(mass, forcing, accelerations, &factors, multipliers);
    return status;
}

#ifndef FB_SPARSE
/* u' for n columns of right-hand sides (f, -gamma). */
int solve_columns(const double *mass, const double *jacobian, int n, const double *sides, double *accelerations)
{
    static fb_factors factors;
    double none[N_U] = {0.0};
    factors = (fb_factors){0};
    const int status = fb_factor(mass, jacobian, none, &factors);
    if (status == FB_OK)
#ifdef FB_RECURSIVE
        fb_solve_columns(sides, n, &factors, accelerations);
#else
        fb_solve_directions(n, sides, &factors, accelerations);
#endif
    return status;
}

/* The orientation of the first N_C columns of J, in the units of all of n matrices J. */
double orientation(int n, const double *jacobians, const double *jacobian, double *factor)
{
    fb_units units = {{0.0}, {0.0}};
    int columns[FB_AT_LEAST_1(N_C)] = {0};
    for (int i = 0; i < N_C; ++i)
        columns[i] = i;
    for (int i = 0; i < n; ++i)
        *factor = fb_note_units(jacobians + i * N_C * N_U, &units);
    return fb_orientation(jacobian, &units, columns);
}

/* Whether J is close to losing rank, in its own units, compared with a least pivot. */
int is_close_by(const double *jacobian, double largest)
{
    fb_units units = {{0.0}, {0.0}};
    fb_note_units(jacobian, &units);
    return fb_is_close_by(jacobian, &units, largest);
}
#endif
