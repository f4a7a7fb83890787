/* The solution of M u' = f + J^T lambda, J u' + gamma = 0, for sizes and tables that are defined on the command line.
 *
 * Dense by default. With FB_SPARSE, M and J are the entries that the tables name. With FB_RECURSIVE, products with M
 * and its inverse, which generated functions would form by recursion, are those with given matrices.
 */
#include <math.h>

#include "arithmetic/array.h"
#include "arithmetic/real.h"

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
PRODUCT(mass_solve_simd, fb_simd, 0)
PRODUCT(mass_product, fb_simd, 1)
#endif
#include "linear_algebra/equations.h"
#ifndef FB_SPARSE
#include "linear_algebra/signed_pivot.h"
#endif

/* A status: of the factorization, or of the solution, for f, gamma and the size of gamma's terms. */
int solve(const double *mass, const double *jacobian, const double *forcing, const double *bias, double terms,
          double *accelerations, double *multipliers, int *kind, double *left)
{
    static fb_factors factors; /* large */
    factors = (fb_factors){0};
    int status = FB_FORM(factor)(mass, jacobian, forcing, &factors);
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
        status = FB_FORM(solve_first)(forcing, bias, &factors, accelerations);
    if (status == FB_OK)
        FB_FORM(multipliers)(mass, forcing, accelerations, &factors, multipliers);
    return status;
}

#ifdef FORCES
enum { N_N = FORCES, N_L = N_C + N_N };

typedef void law_of(const double *n, double *effect, double *effect_jacobian, double *forcing,
                    double *forcing_jacobian);
static law_of *law;
static const double *auxiliary_rows; /* M_a, then J_a^T */

static void unknown_forces(double t, const double *x, const double *constants, const double *r, const double *forces,
                           double *effect, double *effect_jacobian, double *auxiliary_forcing,
                           double *auxiliary_forcing_jacobian, double *auxiliary_mass,
                           double *auxiliary_constraint_jacobian)
{
    (void)t, (void)x, (void)constants, (void)r;
    law(forces, effect, effect_jacobian, auxiliary_forcing, auxiliary_forcing_jacobian);
    for (int i = 0; i < N_N * N_U; ++i)
        auxiliary_mass[i] = auxiliary_rows[i];
    for (int i = 0; i < N_N * N_C; ++i)
        auxiliary_constraint_jacobian[i] = auxiliary_rows[N_N * N_U + i];
}
#include "kernel/unknown_forces.h"

/* u', and lambda followed by n, for forces by a law. */
int solve_with_forces(law_of *given, const double *rows, const double *mass, const double *jacobian,
                      const double *forcing, const double *bias, double *accelerations, double *multipliers)
{
    static fb_factors factors;
    static fb_response response;
    law = given;
    auxiliary_rows = rows;
    const int status = FB_FORM(factor)(mass, jacobian, forcing, &factors);
    return status != FB_OK ? status
                           : fb_solve_with_forces(0.0, NULL, NULL, NULL, mass, forcing, bias, &factors, &response,
                                                  accelerations, multipliers);
}

/* From weights of u' and of (lambda, n): the weights of the auxiliary rows; those of u' and lambda for held n. */
int forces_vjp(law_of *given, const double *rows, const double *mass, const double *jacobian, const double *forces,
               double *of_accelerations, double *of_multipliers, double *of_rows)
{
    static fb_factors factors;
    static fb_response response;
    const double none[N_U] = {0.0};
    law = given;
    auxiliary_rows = rows;
    const int status = FB_FORM(factor)(mass, jacobian, none, &factors);
    if (status != FB_OK || !fb_evaluate_forces(0.0, NULL, NULL, NULL, forces, &response))
        return status != FB_OK ? status : FB_NOT_FINITE;
    fb_form_response(mass, &factors, &response);
    return fb_forces_vjp(&response, of_accelerations, of_multipliers, of_rows);
}
#endif

#ifndef FB_SPARSE
/* u' for n columns of right-hand sides (f, -gamma). */
int solve_columns(const double *mass, const double *jacobian, int n, const double *sides, double *accelerations)
{
    static fb_factors factors;
    double none[N_U] = {0.0};
    factors = (fb_factors){0};
    const int status = FB_FORM(factor)(mass, jacobian, none, &factors);
    if (status == FB_OK)
        FB_FORM(solve_directions)(n, sides, &factors, accelerations);
    return status;
}

/* The signed pivot of the first N_C columns of J, in the units of all of n matrices J. */
double signed_pivot(int n, const double *jacobians, const double *jacobian, double *factor)
{
    fb_units units = {{0.0}, {0.0}};
    int columns[FB_AT_LEAST_1(N_C)] = {0};
    for (int i = 0; i < N_C; ++i)
        columns[i] = i;
    for (int i = 0; i < n; ++i)
        *factor = fb_note_units(jacobians + i * N_C * N_U, &units);
    return fb_signed_pivot(jacobian, &units, columns);
}

/* Whether J is close to losing rank, in its own units, compared with a least pivot. */
int is_close_by(const double *jacobian, double largest)
{
    fb_units units = {{0.0}, {0.0}};
    fb_note_units(jacobian, &units);
    return fb_is_near_singular(jacobian, &units, largest);
}
#endif
