/* Sums over the stages of a Runge-Kutta step, and its interpolant, common to single runs and lanes: FB_VALUE is a
 * double or a vector of them, FB_OF(name) the name of a function, FB_MAGNITUDE and FB_LARGER are those of values;
 * FB_IN_UNITS divides by a unit, of which FB_UNIT is what it takes. FB_AT_ONCE entries of a row are summed at once;
 * rows of n entries are whole blocks of these.
 */

/* base + factor times the weighted sum of rows; base may be NULL. */
static FB_INLINE void FB_OF(fb_combine_rows)(const FB_VALUE *rows, const int n, const fb_weights *w,
                                             const FB_VALUE factor, const FB_VALUE *base, FB_VALUE *restrict result)
{
    for (int i = 0; i < n; i += FB_AT_ONCE) {
        FB_VALUE sum[FB_AT_ONCE] = {(FB_VALUE){0.0}};
        for (int j = 0; j < w->n; ++j) {
            const FB_VALUE *const row = rows + w->stage[j] * n + i;
            const double weight = w->weight[j];
            for (int k = 0; k < FB_AT_ONCE; ++k)
                sum[k] += weight * row[k];
        }
        for (int k = 0; k < FB_AT_ONCE; ++k)
            result[i + k] = (base ? base[i + k] : (FB_VALUE){0.0}) + factor * sum[k];
    }
}

/* The sums of squares of n entries of one or two error estimates, in units of the tolerances. */
static FB_INLINE void FB_OF(fb_error_sums)(const int n, const double *rtol, const double *atol, const FB_VALUE *x,
                                           const FB_VALUE *x_new, const FB_VALUE *error, const FB_VALUE *error3,
                                           FB_VALUE sums[2])
{
    sums[0] = sums[1] = (FB_VALUE){0.0};
    for (int i = 0; i < n; ++i) {
        const FB_VALUE size = FB_MAGNITUDE(x[i]), size_new = FB_MAGNITUDE(x_new[i]);
        const FB_VALUE unit = FB_UNIT(atol[i] + FB_LARGER(size, size_new) * rtol[i]);
        sums[0] += FB_IN_UNITS(error[i], unit) * FB_IN_UNITS(error[i], unit);
        if (error3)
            sums[1] += FB_IN_UNITS(error3[i], unit) * FB_IN_UNITS(error3[i], unit);
    }
}

/* The first three rows of an interpolant's coefficients for a step of length h from x_old to x with the rates f_old and
 * f: the cubic Hermite polynomial. */
static FB_INLINE void FB_OF(fb_hermite_rows)(const int n, const FB_VALUE h, const FB_VALUE *x_old, const FB_VALUE *x,
                                             const FB_VALUE *f_old, const FB_VALUE *f, FB_VALUE *restrict rows)
{
    for (int i = 0; i < n; ++i) {
        const FB_VALUE change = x[i] - x_old[i];
        rows[i] = change;
        rows[n + i] = h * f_old[i] - change;
        rows[2 * n + i] = 2.0 * change - h * (f[i] + f_old[i]);
    }
}

/* The interpolant at a fraction y of a step, for the first n entries: rows of coefficients, of length `padded`. */
static FB_INLINE void FB_OF(fb_interpolate)(const fb_tableau *m, const FB_VALUE *coefficients, const int n,
                                            const int padded, const FB_VALUE *x_old, const FB_VALUE y,
                                            FB_VALUE *restrict x)
{
    const int last = m->n_dense - 1 + (m->hermite ? 3 : 0);
    for (int i = 0; i < n; ++i)
        x[i] = (FB_VALUE){0.0};
    for (int k = last; k >= 0; --k) {
        const FB_VALUE *const row = coefficients + k * padded;
        const FB_VALUE factor = m->hermite && (last - k) % 2 ? 1.0 - y : y;
        for (int i = 0; i < n; ++i)
            x[i] = (x[i] + row[i]) * factor;
    }
    for (int i = 0; i < n; ++i)
        x[i] += x_old[i];
}

#undef FB_VALUE
#undef FB_OF
#undef FB_MAGNITUDE
#undef FB_LARGER
#undef FB_UNIT
#undef FB_IN_UNITS
#undef FB_AT_ONCE
