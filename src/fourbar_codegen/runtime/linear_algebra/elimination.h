/* Gaussian elimination of small dense matrices of any size: with partial pivoting for a square one, with complete
 * pivoting for the rank and the unknowns of m equations. Matrices are stored row by row, and overwritten.
 */
#ifndef FOURBAR_ELIMINATION_H
#define FOURBAR_ELIMINATION_H

#include "../arithmetic/array.h"

#include <math.h>

static inline void fb_swap_double(double *a, double *b)
{
    const double c = *a;
    *a = *b;
    *b = c;
}

static inline void fb_swap_int(int *a, int *b)
{
    const int c = *a;
    *a = *b;
    *b = c;
}

/* P A = L U of m rows and n <= m columns, with partial pivoting, in place: L, whose diagonal is 1, below that of U. The
 * permutation is that of b, of shape (m,), which becomes L^-1 P b, and of `rows`; both may be NULL. Returns its sign,
 * or 0 if a pivot is no larger than `least`. */
static inline int fb_factor_lu(const int m, const int n, double *restrict a, double *restrict b, int *restrict rows,
                               const double least)
{
    int sign = 1;
    for (int k = 0; k < n; ++k) {
        int pivot = k;
        for (int i = k + 1; i < m; ++i)
            pivot = fabs(a[i * n + k]) > fabs(a[pivot * n + k]) ? i : pivot;
        if (!(fabs(a[pivot * n + k]) > least))
            return 0;
        if (pivot != k) {
            sign = -sign;
            for (int j = 0; j < n; ++j)
                fb_swap_double(a + k * n + j, a + pivot * n + j);
            if (b)
                fb_swap_double(b + k, b + pivot);
            if (rows)
                fb_swap_int(rows + k, rows + pivot);
        }
        for (int i = k + 1; i < m; ++i) {
            const double factor = a[i * n + k] /= a[k * n + k];
            for (int j = k + 1; j < n; ++j)
                a[i * n + j] -= factor * a[k * n + j];
            if (b)
                b[i] -= factor * b[k];
        }
    }
    return sign;
}

/* Solves A x = b; A and b are overwritten. Returns 0 if A is singular: a pivot is no larger than `least`. */
static inline int fb_eliminate_full(const int n, double *restrict a, double *restrict b, const double least)
{
    if (!fb_factor_lu(n, n, a, b, NULL, least))
        return 0;
    for (int k = n - 1; k >= 0; --k) {
        for (int j = k + 1; j < n; ++j)
            b[k] -= a[k * n + j] * b[j];
        b[k] /= a[k * n + k];
    }
    return 1;
}

/* Solves A x = b by the factors of P A, and the rows of P. */
static inline void fb_solve_lu(const int n, const double *restrict a, const int *restrict rows,
                               const double *restrict b, double *restrict x)
{
    for (int k = 0; k < n; ++k) {
        x[k] = b[rows[k]];
        for (int j = 0; j < k; ++j)
            x[k] -= a[k * n + j] * x[j];
    }
    for (int k = n - 1; k >= 0; --k) {
        for (int j = k + 1; j < n; ++j)
            x[k] -= a[k * n + j] * x[j];
        x[k] /= a[k * n + k];
    }
}

/* P A = L U of a complex square matrix, whose real and imaginary parts are apart; pivots are replaced by their
 * reciprocals. Returns 0 if a pivot is 0. */
static inline int fb_factor_complex(const int n, double *restrict re, double *restrict im, int *restrict rows)
{
    for (int k = 0; k < n; ++k) {
        int pivot = k;
        double largest = 0.0;
        for (int i = k; i < n; ++i) {
            const double size = fabs(re[i * n + k]) + fabs(im[i * n + k]);
            if (size > largest) {
                largest = size;
                pivot = i;
            }
        }
        if (!(largest > 0.0))
            return 0;
        for (int j = 0; j < n && pivot != k; ++j) {
            fb_swap_double(re + k * n + j, re + pivot * n + j);
            fb_swap_double(im + k * n + j, im + pivot * n + j);
        }
        fb_swap_int(rows + k, rows + pivot);
        const double a = re[k * n + k] / largest, b = im[k * n + k] / largest, square = (a * a + b * b) * largest;
        const double p = re[k * n + k] = a / square, q = im[k * n + k] = -b / square;
        for (int i = k + 1; i < n; ++i) {
            const double x = re[i * n + k], y = im[i * n + k];
            const double u = re[i * n + k] = x * p - y * q, v = im[i * n + k] = x * q + y * p;
            for (int j = k + 1; j < n; ++j) {
                re[i * n + j] -= u * re[k * n + j] - v * im[k * n + j];
                im[i * n + j] -= u * im[k * n + j] + v * re[k * n + j];
            }
        }
    }
    return 1;
}

/* Solves A (x + i y) = b + i c by these factors. */
static inline void fb_solve_complex(const int n, const double *restrict re, const double *restrict im,
                                    const int *restrict rows, const double *restrict b, const double *restrict c,
                                    double *restrict x, double *restrict y)
{
    for (int k = 0; k < n; ++k) {
        x[k] = b[rows[k]];
        y[k] = c[rows[k]];
        for (int j = 0; j < k; ++j) {
            x[k] -= re[k * n + j] * x[j] - im[k * n + j] * y[j];
            y[k] -= re[k * n + j] * y[j] + im[k * n + j] * x[j];
        }
    }
    for (int k = n - 1; k >= 0; --k) {
        double u = x[k], v = y[k];
        for (int j = k + 1; j < n; ++j) {
            u -= re[k * n + j] * x[j] - im[k * n + j] * y[j];
            v -= re[k * n + j] * y[j] + im[k * n + j] * x[j];
        }
        x[k] = u * re[k * n + k] - v * im[k * n + k];
        y[k] = u * im[k * n + k] + v * re[k * n + k];
    }
}

/* The sign of det A times its least pivot with partial pivoting; A is overwritten. */
static inline double fb_signed_least_pivot(const int n, double *restrict a)
{
    double least = INFINITY, sign = fb_factor_lu(n, n, a, NULL, NULL, 0.0);
    for (int k = 0; k < n && sign != 0.0; ++k) {
        least = fb_min(fabs(a[k * n + k]), least);
        sign = a[k * n + k] < 0.0 ? -sign : sign;
    }
    return sign != 0.0 ? sign * least : 0.0;
}

/* The pivot p by complete pivoting: the largest entry from row and column p on is brought there from a row and a
 * column; returns its size. */
static inline double fb_pivot_completely(const int m, const int n, double *restrict a, const int p, int *row,
                                         int *column)
{
    *row = *column = p;
    for (int i = p; i < m; ++i)
        for (int j = p; j < n; ++j)
            if (fabs(a[i * n + j]) > fabs(a[*row * n + *column])) {
                *row = i;
                *column = j;
            }
    for (int j = 0; j < n && *row != p; ++j)
        fb_swap_double(a + p * n + j, a + *row * n + j);
    for (int i = 0; i < m && *column != p; ++i)
        fb_swap_double(a + i * n + p, a + i * n + *column);
    return fabs(a[p * n + p]);
}

/* Gaussian elimination with complete pivoting of m rows and n columns with k right-hand sides, of shape (m, k). Stops
 * after as many pivots as asked for, or at one that is not above FB_CLOSURE_PIVOT_RATIO, and returns their number; the
 * last one is stored. */
static inline int fb_reduce_rows(const int m, const int n, const int k, const int pivots, double *restrict a,
                                 double *restrict b, int *restrict order, double *last)
{
    for (int j = 0; j < n; ++j)
        order[j] = j;
    int rank = 0;
    *last = n > 0 ? 0.0 : 1.0;
    for (int p = 0; p < pivots && p < m; ++p) {
        int row, column;
        *last = fb_pivot_completely(m, n, a, p, &row, &column);
        if (!(*last > FB_CLOSURE_PIVOT_RATIO))
            break;
        for (int j = 0; j < k && row != p; ++j)
            fb_swap_double(b + p * k + j, b + row * k + j);
        fb_swap_int(order + p, order + column);
        for (int i = p + 1; i < m; ++i) {
            const double factor = a[i * n + p] / a[p * n + p];
            for (int j = p; j < n; ++j)
                a[i * n + j] -= factor * a[p * n + j];
            for (int j = 0; j < k; ++j)
                b[i * k + j] -= factor * b[p * k + j];
        }
        rank = p + 1;
    }
    return rank;
}

/* Solves the rows of up to n pivots so: the unknowns have the shape (n, k), those without a pivot are 0. Returns the
 * number of pivots, and stores the last one. */
static inline int fb_eliminate_rows(const int m, const int n, const int k, double *restrict a, double *restrict b,
                                    int *restrict order, double *restrict solution, double *last)
{
    const int rank = fb_reduce_rows(m, n, k, n, a, b, order, last);
    for (int j = 0; j < n * k; ++j)
        solution[j] = 0.0;
    for (int p = rank - 1; p >= 0; --p)
        for (int j = 0; j < k; ++j) {
            double sum = b[p * k + j];
            for (int i = p + 1; i < rank; ++i)
                sum -= a[p * n + i] * solution[order[i] * k + j];
            solution[order[p] * k + j] = sum / a[p * n + p];
        }
    return rank;
}

/* Divides m rows and n columns, and a right-hand side, by their largest entries. */
static inline void fb_balance(const int m, const int n, double *restrict a, double *restrict b, double *restrict unit)
{
    for (int j = 0; j < n; ++j) {
        unit[j] = 0.0;
        for (int i = 0; i < m; ++i)
            unit[j] = fb_max(unit[j], fabs(a[i * n + j]));
    }
    for (int i = 0; i < m; ++i) {
        double size = 0.0;
        for (int j = 0; j < n; ++j) {
            a[i * n + j] /= unit[j] > 0.0 ? unit[j] : 1.0;
            size = fb_max(size, fabs(a[i * n + j]));
        }
        for (int j = 0; j < n && size > 0.0; ++j)
            a[i * n + j] /= size;
        b[i] /= size > 0.0 ? size : 1.0;
    }
}

#endif
