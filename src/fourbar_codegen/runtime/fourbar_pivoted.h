/* The part of fourbar_solve.h after the choice of a pivot order, common to single states and lanes: FB_VALUE is a
 * double or a vector of them, FB_FACTORS the type of the factors, FB_OF(name) the name of a function.
 * FB_REQUIRE_POSITIVE(s, value), defined before inclusion, handles values that are not positive. If FB_SIDE is defined,
 * only `fb_back` is, for right-hand sides of this type.
 *
 * `order` is the static pivot order, so that indices are known at compile time, or one that was found at run time.
 */

#ifndef FB_SIDE
#define FB_SIDE FB_VALUE

/* Row k below the diagonal of U_d, by a pivot that is not zero. */
static FB_INLINE void FB_OF(fb_eliminate_below)(FB_VALUE lu[][N_U], FB_VALUE *restrict inverse, const int k)
{
    inverse[k] = 1.0 / lu[k][k];
    for (int i = k + 1; i < N_C; ++i) {
        const FB_VALUE factor = lu[i][k] *= inverse[k];
        for (int j = k + 1; j < N_U; ++j)
            lu[i][j] -= factor * lu[k][j];
    }
}

/* A and T^T M T = L D L^T. */
static FB_INLINE int FB_OF(fb_reduce)(const FB_VALUE *restrict mass_matrix, FB_FACTORS *restrict s, const int *order)
{
    for (int k = N_RANK - 1; k >= 0; --k)
        for (int j = N_RANK; j < N_U; ++j) {
            FB_VALUE sum = s->lu[k][j];
            for (int i = k + 1; i < N_RANK; ++i)
                sum += s->lu[k][i] * s->lu[i][j];
            s->lu[k][j] = -s->inverse[k] * sum;
        }
    for (int i = 0; i < N_U; ++i)
        for (int j = 0; j < N_U; ++j)
            s->mass[i][j] = mass_matrix[order[i] * N_U + order[j]];
    for (int b = N_RANK; b < N_U; ++b) {
        FB_VALUE product[N_U]; /* column b of M T */
        for (int i = 0; i < N_U; ++i) {
            product[i] = s->mass[i][b];
            for (int d = 0; d < N_RANK; ++d)
                product[i] += s->mass[i][d] * s->lu[d][b];
        }
        for (int a = b; a < N_U; ++a) {
            FB_VALUE sum = product[a];
            for (int d = 0; d < N_RANK; ++d)
                sum += s->lu[d][a] * product[d];
            s->reduced[a][b] = sum;
        }
    }
    for (int b = N_RANK; b < N_U; ++b) {
        FB_REQUIRE_POSITIVE(s, s->reduced[b][b]);
        s->reduced[b][b] = 1.0 / s->reduced[b][b];
        for (int a = N_U - 1; a > b; --a) {
            const FB_VALUE factor = s->reduced[a][b] * s->reduced[b][b];
            for (int c = b + 1; c <= a; ++c)
                s->reduced[a][c] -= factor * s->reduced[c][b];
            s->reduced[a][b] = factor;
        }
    }
    return FB_OK;
}

#endif

/* u' from f (zeros if NULL) and w = L^-1 P S gamma. */
static FB_INLINE void FB_OF(fb_back)(const FB_SIDE *restrict forcing, const FB_SIDE *restrict w,
                                     const FB_FACTORS *restrict s, FB_SIDE *restrict accelerations, const int *order)
{
    FB_SIDE v[N_U], g[N_U];
    for (int k = N_RANK - 1; k >= 0; --k) {
        FB_SIDE sum = -w[k];
        for (int i = k + 1; i < N_RANK; ++i)
            sum -= s->lu[k][i] * v[i];
        v[k] = sum * s->inverse[k];
    }
    for (int i = 0; i < N_U; ++i) {
        g[i] = forcing ? forcing[order[i]] : (FB_SIDE){0.0};
        for (int d = 0; d < N_RANK; ++d)
            g[i] -= s->mass[i][d] * v[d];
    }
    for (int a = N_RANK; a < N_U; ++a) {
        FB_SIDE sum = g[a];
        for (int d = 0; d < N_RANK; ++d)
            sum += s->lu[d][a] * g[d];
        for (int c = N_RANK; c < a; ++c)
            sum -= s->reduced[a][c] * v[c];
        v[a] = sum;
    }
    for (int a = N_U - 1; a >= N_RANK; --a) {
        v[a] *= s->reduced[a][a];
        for (int c = a + 1; c < N_U; ++c)
            v[a] -= s->reduced[c][a] * v[c];
    }
    for (int d = 0; d < N_RANK; ++d)
        for (int a = N_RANK; a < N_U; ++a)
            v[d] += s->lu[d][a] * v[a];
    for (int i = 0; i < N_U; ++i)
        accelerations[order[i]] = v[i];
}

#undef FB_VALUE
#undef FB_SIDE
#undef FB_FACTORS
#undef FB_OF
#undef FB_REQUIRE_POSITIVE
