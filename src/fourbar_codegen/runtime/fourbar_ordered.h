/* Solves M u' = f + J^T lambda, J u' + gamma = 0 with sparse M and J.
 *
 * With a weight w > 0 for each constraint, u' and lambda solve
 *
 *     [M + J^T w J   J^T] [  u'   ]   [f - J^T w gamma]
 *     [     J         0 ] [-lambda] = [    -gamma     ]
 *
 * The matrix is factored as L D L^T in an order that was fixed at code generation. No pivoting is needed: the upper
 * left block is positive definite wherever the equations determine u', and each constraint comes after all speeds in
 * it. If the factorization fails, the constraints are dependent at this state. With FB_EARLY, constraints come before
 * some of their speeds; if it fails, they are dependent, or have small pivots, without these speeds.
 *
 * Common to single states and lanes: FB_VALUE is a double or a vector of them, FB_FACTORS the type of the factors,
 * FB_OF(name) the name of a function. FB_REQUIRE(s, condition, status), defined before inclusion, handles values that
 * do not satisfy a condition, FB_SELECT(condition, yes, no) is one of two values, FB_ABS(value) the absolute one.
 *
 * The model's tables are:
 *   mass_row, mass_column         rows and columns of the entries of M on and below the diagonal
 *   jacobian_row, jacobian_column the entries of J: the first of each row, and the columns
 *   unknown                       the unknown of each step: speeds, then N_U and more for constraints
 *   column, below                 the later steps with an entry in a step's column: the first of them, and all
 *   mass_place, jacobian_place, pair_place, target
 *                                 places of M, J, the products of J^T w J, and of what a step subtracts
 */

/* Pivots below this fraction of the terms subtracted from them are rounding errors. */
#define FB_PIVOT_RATIO 1e-13
/* Smallest pivot of an early constraint, relative to what it is of with all its speeds: an error of 1e-12 at worst. */
#define FB_EARLY_PIVOT_RATIO 1e-4

/* The weights, which give both terms of M + J^T w J similar size; no row may be only rounding errors. */
static FB_INLINE int FB_OF(fb_weigh)(const FB_VALUE *restrict diagonal, FB_FACTORS *restrict s)
{
    FB_VALUE size[FB_AT_LEAST_1(N_C)], largest = {0.0};
    for (int row = 0; row < N_C; ++row) {
        size[row] = (FB_VALUE){0.0};
        for (int i = jacobian_row[row]; i < jacobian_row[row + 1]; ++i)
            size[row] += s->jacobian[i] * s->jacobian[i];
        largest = FB_SELECT(size[row] > largest, size[row], largest);
    }
    for (int row = 0; row < N_C; ++row) {
        FB_VALUE mass = {0.0};
        for (int i = jacobian_row[row]; i < jacobian_row[row + 1]; ++i)
            mass += diagonal[jacobian_column[i]];
        FB_REQUIRE(s, size[row] > FB_ROW_RTOL * FB_ROW_RTOL * largest, FB_CONSTRAINTS_DEPENDENT);
        s->weight[row] = FB_SELECT(mass > 0.0, mass, (FB_VALUE){0.0} + 1.0) / size[row];
    }
    return FB_OK;
}

static FB_INLINE int FB_OF(fb_factor_ordered)(const FB_VALUE *restrict mass_matrix, const FB_VALUE *restrict jacobian,
                                              FB_FACTORS *restrict s)
{
    FB_VALUE *restrict const entries = s->entries;
    FB_VALUE diagonal[N_U], size[N_STEPS];
    for (int i = 0; i < N_U; ++i)
        diagonal[i] = (FB_VALUE){0.0};
    for (int i = 0; i < N_STEPS + N_BELOW; ++i)
        entries[i] = (FB_VALUE){0.0};
    for (int i = 0; i < N_MASS; ++i) {
        entries[mass_place[i]] += mass_matrix[i];
        if (mass_row[i] == mass_column[i])
            diagonal[mass_row[i]] = mass_matrix[i];
    }
    for (int i = 0; i < N_JACOBIAN; ++i)
        s->jacobian[i] = jacobian[i];
    const int status = FB_OF(fb_weigh)(diagonal, s);
    if (status != FB_OK)
        return status;
    for (int row = 0, pair = 0; row < N_C; ++row) {
        for (int i = jacobian_row[row]; i < jacobian_row[row + 1]; ++i) {
            entries[jacobian_place[i]] = jacobian[i];
            const FB_VALUE weighted = s->weight[row] * jacobian[i];
            for (int j = jacobian_row[row]; j <= i; ++j)
                entries[pair_place[pair++]] += weighted * jacobian[j];
        }
    }
    for (int k = 0; k < N_STEPS; ++k)
        size[k] = FB_ABS(entries[k]);
    for (int k = 0, next = 0; k < N_STEPS; ++k) {
        const FB_VALUE pivot = unknown[k] < N_U ? entries[k] : -entries[k];
        FB_REQUIRE(s, pivot > FB_PIVOT_RATIO * size[k], unknown[k] < N_U ? FB_MASS_SINGULAR : FB_CONSTRAINTS_DEPENDENT);
#ifdef FB_EARLY
        if (unknown[k] >= N_U) {
            FB_REQUIRE(s, pivot * s->weight[unknown[k] - N_U] > FB_EARLY_PIVOT_RATIO, FB_CONSTRAINTS_DEPENDENT);
        }
#endif
        const FB_VALUE inverse = entries[k] = 1.0 / entries[k];
        FB_VALUE *restrict const l = entries + N_STEPS + column[k];
        const int *restrict const later = below + column[k];
        for (int i = column[k + 1] - column[k] - 1; i >= 0; --i) {
            const FB_VALUE scaled = l[i] * inverse;
            size[later[i]] += FB_ABS(scaled * l[i]);
            for (int j = 0; j <= i; ++j)
                entries[target[next++]] -= scaled * l[j];
            l[i] = scaled;
        }
    }
    return FB_OK;
}

/* The unknowns for right-hand sides in the order of the steps. */
static FB_INLINE void FB_OF(fb_substitute)(const FB_FACTORS *restrict s, FB_VALUE *restrict y)
{
    const FB_VALUE *restrict const l = s->entries + N_STEPS;
    for (int k = 0; k < N_STEPS; ++k) {
        for (int i = column[k]; i < column[k + 1]; ++i)
            y[below[i]] -= l[i] * y[k];
        y[k] *= s->entries[k];
    }
    for (int k = N_STEPS - 1; k >= 0; --k)
        for (int i = column[k]; i < column[k + 1]; ++i)
            y[k] -= l[i] * y[below[i]];
}

/* u' for one right-hand side (f, gamma); NULL for f means zeros. */
static FB_INLINE void FB_OF(fb_solve_ordered)(const FB_VALUE *restrict forcing,
                                              const FB_VALUE *restrict acceleration_bias, const FB_FACTORS *restrict s,
                                              FB_VALUE *restrict accelerations)
{
    FB_VALUE side[N_STEPS], y[N_STEPS];
    for (int i = 0; i < N_U; ++i)
        side[i] = forcing ? forcing[i] : (FB_VALUE){0.0};
    for (int row = 0; row < N_C; ++row) {
        side[N_U + row] = -acceleration_bias[row];
        for (int i = jacobian_row[row]; i < jacobian_row[row + 1]; ++i)
            side[jacobian_column[i]] -= s->jacobian[i] * s->weight[row] * acceleration_bias[row];
    }
    for (int k = 0; k < N_STEPS; ++k)
        y[k] = side[unknown[k]];
    FB_OF(fb_substitute)(s, y);
    for (int k = 0; k < N_STEPS; ++k)
        if (unknown[k] < N_U)
            accelerations[unknown[k]] = y[k];
}

#undef FB_PIVOT_RATIO
#undef FB_EARLY_PIVOT_RATIO
#undef FB_VALUE
#undef FB_FACTORS
#undef FB_OF
#undef FB_ABS
#undef FB_SELECT
#undef FB_REQUIRE
