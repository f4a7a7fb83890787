/* The part of fourbar_recursive.h after W = M^-1 J^T is known, common to single states and lanes: FB_VALUE is a double
 * or a vector of them, FB_FACTORS the type of the factors, FB_OF(name) the name of a function. FB_RESPONSE(s, j, i) is
 * an entry of W. FB_REQUIRE(s, condition) handles values that do not satisfy a condition.
 */

/* Smallest pivot of A relative to its diagonal for which its factors are used. */
#define FB_CONDITION_RATIO 1e-7

#ifdef FB_REQUIRE
/* A = L D L^T, in place. The factors count only if A is well-conditioned. */
static FB_INLINE int FB_OF(fb_factor_normal)(FB_FACTORS *restrict s)
{
    FB_VALUE size[FB_AT_LEAST_1(N_C)];
    for (int i = 0; i < N_C; ++i)
        size[i] = s->normal[i][i];
    for (int k = 0; k < N_C; ++k) {
        FB_REQUIRE(s, s->normal[k][k] > FB_CONDITION_RATIO * size[k]);
        s->normal[k][k] = 1.0 / s->normal[k][k];
        for (int i = N_C - 1; i > k; --i) {
            const FB_VALUE factor = s->normal[i][k] * s->normal[k][k];
            for (int j = k + 1; j <= i; ++j)
                s->normal[i][j] -= factor * s->normal[j][k];
            s->normal[i][k] = factor;
        }
    }
    return 1;
}
#endif

/* v <- -A^-1 v */
static FB_INLINE void FB_OF(fb_solve_normal)(const FB_FACTORS *restrict s, FB_VALUE *restrict v)
{
    for (int i = 1; i < N_C; ++i)
        for (int k = 0; k < i; ++k)
            v[i] -= s->normal[i][k] * v[k];
    for (int i = N_C - 1; i >= 0; --i) {
        v[i] *= -s->normal[i][i];
        for (int k = i + 1; k < N_C; ++k)
            v[i] -= s->normal[k][i] * v[k];
    }
}

/* From M^-1 f to u'; the second time, the errors of A^-1 are removed. */
static FB_INLINE void FB_OF(fb_constrain)(const FB_VALUE *restrict acceleration_bias, const FB_FACTORS *restrict s,
                                          FB_VALUE *restrict accelerations)
{
    for (int refinement = 0; refinement < 2 && N_C > 0; ++refinement) {
        FB_VALUE v[FB_AT_LEAST_1(N_C)];
        for (int i = 0; i < N_C; ++i) {
            v[i] = acceleration_bias[i];
            for (int j = 0; j < N_U; ++j)
                v[i] += s->jacobian[i * N_U + j] * accelerations[j];
        }
        FB_OF(fb_solve_normal)(s, v);
        for (int j = 0; j < N_U; ++j)
            for (int i = 0; i < N_C; ++i)
                accelerations[j] += FB_RESPONSE(s, j, i) * v[i];
    }
}

#undef FB_CONDITION_RATIO
#undef FB_VALUE
#undef FB_FACTORS
#undef FB_OF
#undef FB_REQUIRE
