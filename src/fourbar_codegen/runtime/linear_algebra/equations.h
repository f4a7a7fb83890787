/* The equations M u' = f + J^T lambda, J u' + gamma = 0 in the form that a model's source defines: FB_SPARSE,
 * FB_RECURSIVE, or dense. FB_FORM(name) is a function of the form:
 *
 *   factor            of M and J, for any number of right-hand sides; f is the first of them
 *   solve             u' for one right-hand side (f, gamma); `solve_first` for f as given to `factor`
 *   solve_directions  u' for n right-hand sides (f, -gamma), in the columns of a matrix
 *   multipliers       lambda for a solution u'
 *   fill              M and J with all their entries, for forms that have others
 *   dense             the dense factors, where redundant rows are found
 *   columns           the speeds that are dependent, in the order of the pivots
 *   is_static         whether these are those of the static pivot order
 */
#ifndef FOURBAR_EQUATIONS_H
#define FOURBAR_EQUATIONS_H

#if defined(FB_SPARSE)
#include "sparse_equations.h"
#define FB_FORM(name) fb_sparse_##name
#elif defined(FB_RECURSIVE)
#include "recursive_equations.h"
#define FB_FORM(name) fb_recursive_##name
#else
#include "dense_equations.h"
#define FB_DENSE
#define FB_FORM(name) fb_dense_##name
#endif

typedef FB_FORM(factors) fb_factors;

#endif
