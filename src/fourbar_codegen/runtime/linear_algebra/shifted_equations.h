/* Solves (s I - A) x = b for a real and a complex number s, as the stages of implicit methods need.
 *
 * Unknowns whose row of A has no entry but one of another unknown, x_i = (b_i + a_ij x_j) / s, are eliminated first:
 * the coordinates of most mechanisms, since q' = u. Half of the unknowns are left, and an eighth of the work, as in the
 * code RADAU5 of E. Hairer and G. Wanner for systems of second order.
 */
#ifndef FOURBAR_SHIFTED_EQUATIONS_H
#define FOURBAR_SHIFTED_EQUATIONS_H

#include "elimination.h"

typedef struct fb_shifted {
    int n, n_left;
    double *matrix;         /* (n, n): A */
    double *coupling;       /* (n,): a_ij of those that are eliminated */
    double *real, *re, *im; /* (n_left, n_left): the factors for the real and for the complex number */
    double *given, *found;  /* (2, n): right-hand sides and solutions */
    int *left;              /* (n,): the numbers of the unknowns that are left, then of those that are eliminated */
    int *partner;           /* (n,): of those that are eliminated, the place of j among those left, or -1 */
    int *real_rows, *complex_rows;
    double inverse, inverse_re, inverse_im; /* of the numbers */
} fb_shifted;

/* The length of the arrays for n unknowns, in doubles. */
#define FB_SHIFTED_LENGTH(n) (4 * (n) * (n) + 5 * (n) + 4 * (((n) + 1) / 2))

/* Places the arrays in memory, unless that is NULL; returns their number of doubles. */
static inline size_t fb_place_shifted(fb_shifted *e, const int n, double *memory)
{
    double *whole[4]; /* of integers */
    const int half = (n + 1) / 2;
    const fb_place places[] = {
        {&e->matrix, n * n}, {&e->real, n * n},  {&e->re, n * n},    {&e->im, n * n},
        {&e->coupling, n},   {&e->given, 2 * n}, {&e->found, 2 * n}, {whole, half},
        {whole + 1, half},   {whole + 2, half},  {whole + 3, half},
    };
    const size_t length = fb_place_all(places, sizeof places / sizeof *places, memory);
    e->n = n;
    if (memory) {
        e->left = (int *)(void *)whole[0];
        e->partner = (int *)(void *)whole[1];
        e->real_rows = (int *)(void *)whole[2];
        e->complex_rows = (int *)(void *)whole[3];
    }
    return length;
}

/* The only entry of a row of A, which is not on its diagonal; -1 if the row is empty, -2 if it has more. */
static inline int fb_only_entry(const fb_shifted *e, const int row)
{
    int only = -1;
    for (int j = 0; j < e->n; ++j)
        if (e->matrix[row * e->n + j] != 0.0) {
            if (only >= 0 || j == row)
                return -2;
            only = j;
        }
    return only;
}

/* Chooses the unknowns that are eliminated, when the matrix is new. */
static inline void fb_order_shifted(fb_shifted *e)
{
    enum { LEFT = -1 }; /* others have the number of their partner, or n */
    const int n = e->n;
    int *const kind = e->real_rows;
    int n_left = 0, last = n;
    for (int i = 0; i < n; ++i)
        kind[i] = 0;
    for (int i = 0; i < n; ++i) { /* a partner is left */
        const int only = kind[i] == LEFT ? -2 : fb_only_entry(e, i);
        kind[i] = only == -2 || (only >= 0 && only < i && kind[only] != LEFT) ? LEFT : only < 0 ? n : only;
        if (kind[i] >= 0 && only >= 0)
            kind[only] = LEFT;
    }
    for (int i = 0; i < n; ++i)
        if (kind[i] == LEFT)
            e->left[n_left++] = i;
    for (int i = n - 1; i >= 0; --i)
        if (kind[i] != LEFT) {
            e->left[--last] = i;
            e->partner[last] = -1;
            for (int k = 0; k < n_left; ++k)
                e->partner[last] = e->left[k] == kind[i] ? k : e->partner[last];
            e->coupling[last] = kind[i] < n ? e->matrix[i * n + kind[i]] : 0.0;
        }
    e->n_left = n_left;
}

/* The matrices of the unknowns that are left: s - a - b / s, with b = a_ki a_ij of those that are eliminated. Returns 0
 * if one is singular. */
static inline int fb_factor_shifted(fb_shifted *e, const double s, const double s_re, const double s_im)
{
    const int n = e->n, m = e->n_left;
    const double square = s_re * s_re + s_im * s_im;
    e->inverse = 1.0 / s;
    e->inverse_re = s_re / square;
    e->inverse_im = -s_im / square;
    for (int k = 0; k < m; ++k) {
        const double *const row = e->matrix + e->left[k] * n;
        double *const real = e->real + k * m, *const re = e->re + k * m, *const im = e->im + k * m;
        for (int j = 0; j < m; ++j) {
            real[j] = re[j] = -row[e->left[j]];
            im[j] = 0.0;
        }
        real[k] += s;
        re[k] += s_re;
        im[k] += s_im;
        for (int i = m; i < n; ++i) {
            const int j = e->partner[i];
            if (j >= 0) {
                const double b = row[e->left[i]] * e->coupling[i];
                real[j] -= b * e->inverse;
                re[j] -= b * e->inverse_re;
                im[j] -= b * e->inverse_im;
            }
        }
        e->real_rows[k] = e->complex_rows[k] = k;
    }
    return fb_factor_lu(m, m, e->real, NULL, e->real_rows, 0.0) && fb_factor_complex(m, e->re, e->im, e->complex_rows);
}

/* (s I - A) x = b for the real number. */
static inline void fb_solve_shifted(const fb_shifted *e, const double *b, double *x)
{
    const int n = e->n, m = e->n_left;
    for (int k = 0; k < m; ++k) {
        const double *const row = e->matrix + e->left[k] * n;
        double sum = 0.0;
        for (int i = m; i < n; ++i)
            sum += row[e->left[i]] * b[e->left[i]];
        e->given[k] = b[e->left[k]] + sum * e->inverse;
    }
    fb_solve_lu(m, e->real, e->real_rows, e->given, e->found);
    for (int k = 0; k < m; ++k)
        x[e->left[k]] = e->found[k];
    for (int i = m; i < n; ++i) {
        const double of_partner = e->partner[i] < 0 ? 0.0 : e->coupling[i] * e->found[e->partner[i]];
        x[e->left[i]] = (b[e->left[i]] + of_partner) * e->inverse;
    }
}

/* (s I - A) (x + i y) = b + i c for the complex number. */
static inline void fb_solve_shifted_complex(const fb_shifted *e, const double *b, const double *c, double *x, double *y)
{
    const int n = e->n, m = e->n_left;
    const double p = e->inverse_re, q = e->inverse_im;
    double *const found_y = e->found + n;
    for (int k = 0; k < m; ++k) {
        const double *const row = e->matrix + e->left[k] * n;
        double u = 0.0, v = 0.0;
        for (int i = m; i < n; ++i) {
            u += row[e->left[i]] * b[e->left[i]];
            v += row[e->left[i]] * c[e->left[i]];
        }
        e->given[k] = b[e->left[k]] + u * p - v * q;
        e->given[n + k] = c[e->left[k]] + u * q + v * p;
    }
    fb_solve_complex(m, e->re, e->im, e->complex_rows, e->given, e->given + n, e->found, found_y);
    for (int k = 0; k < m; ++k) {
        x[e->left[k]] = e->found[k];
        y[e->left[k]] = found_y[k];
    }
    for (int i = m; i < n; ++i) {
        const int j = e->partner[i];
        const double u = b[e->left[i]] + (j < 0 ? 0.0 : e->coupling[i] * e->found[j]);
        const double v = c[e->left[i]] + (j < 0 ? 0.0 : e->coupling[i] * found_y[j]);
        x[e->left[i]] = u * p - v * q;
        y[e->left[i]] = u * q + v * p;
    }
}

#endif
