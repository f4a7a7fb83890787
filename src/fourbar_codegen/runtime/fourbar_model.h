/* The part of a kernel that is the same for every model: it solves the equations from the generated functions.
 *
 * Included once, at the end of a generated source, which defines N_Q, N_U, ..., the functions `prepare` to
 * `output`, and the names of tables: FB_TABLE(kernel), FB_TABLE(batch_functions), and FB_DERIVATIVES, which is in
 * another source. A kernel may be compiled in two units in parallel: FB_RHS_ONLY has the right-hand side, which takes
 * longest, and FB_WITHOUT_RHS everything else.
 */
#include "fourbar_array.h"
#include "fourbar_kernel.h"

#if defined(FB_SPARSE)
#include "fourbar_sparse.h"
#elif defined(FB_RECURSIVE)
#include "fourbar_recursive.h"
#else
#include "fourbar_solve.h"
#endif

#ifndef N_Z
#define N_Z 0
#endif
#ifndef N_N /* unknown forces that drive the motion */
#define N_N 0
#endif
enum {
    N_L = N_C + N_N,
    N_X = N_Q + N_U + N_Z,
    N_COLUMNS = N_X > N_P ? (N_X > N_R ? N_X : N_R) : (N_P > N_R ? N_P : N_R)
};

#if N_N > 0
#include "fourbar_forces.h"
#endif

typedef struct fb_work {
    double coordinate_rates[FB_AT_LEAST_1(N_Q)];
    double mass_matrix[N_MASS];
    double forcing[N_U];
    double constraint_jacobian[FB_AT_LEAST_1(N_JACOBIAN)];
    double acceleration_bias[FB_AT_LEAST_1(N_C)];
    fb_factors factors;
    double accelerations[N_U];
    double multipliers[FB_AT_LEAST_1(N_L)];
    double residual_jacobian[(N_U + N_L + N_Z) * N_COLUMNS];
#ifndef FB_LIBRARY
    double residual_tangent[(N_U + N_L + N_Z) * FB_DIRECTIONS], gradient[N_X + N_P + N_R];
#endif
#if N_Z > 0
    double state_rate_acceleration_jacobian[N_Z * N_U], state_rate_multiplier_jacobian[FB_AT_LEAST_1(N_Z * N_L)];
#endif
#if N_N > 0
    fb_response response;
#endif
    double jacobian_before[FB_AT_LEAST_1(N_JACOBIAN)]; /* J when `toggled` was last called */
#ifndef FB_SPARSE
    fb_units units; /* of J in all calls of `toggled` */
    double signed_pivot_before;
    int was_static;
#endif
    double largest_pivot; /* in all calls, in the present units; 0 before the first */
    double drift;         /* the relative constraint violation where the last projection took its factors */
} fb_work;

/* Factors of a state with a smaller violation serve for the tangent of the closed one: what they leave of a direction's
 * violation is this fraction of it. */
#define FB_SLIGHT_DRIFT_RTOL 1e-9

#if defined(FB_RECURSIVE)
/* M instead of its factors. */
static void full_dynamics(double t, const double *x, const double *constants, const double *r, double *coordinate_rates,
                          double *mass_matrix, double *forcing, double *constraint_jacobian, double *acceleration_bias)
{
    double mass[N_MASS];
    dynamics(t, x, constants, r, coordinate_rates, mass, forcing, constraint_jacobian, acceleration_bias);
    fb_form_mass(constants, mass + N_U, mass_matrix);
}
#elif defined(FB_SPARSE)
/* The matrices of `dynamics` with their zeros. */
static void full_dynamics(double t, const double *x, const double *constants, const double *r, double *coordinate_rates,
                          double *mass_matrix, double *forcing, double *constraint_jacobian, double *acceleration_bias)
{
    double mass[N_MASS], jacobian[FB_AT_LEAST_1(N_JACOBIAN)];
    dynamics(t, x, constants, r, coordinate_rates, mass, forcing, jacobian, acceleration_bias);
    fb_fill(mass, jacobian, mass_matrix, constraint_jacobian);
}
#else
#define full_dynamics dynamics
#endif

/* The factors at a state. Constraints that are redundant only on the constraint manifold become independent where loops
 * are open, which is distinguished from constraints that always were. */
static inline int factor_at(double t, const double *x, const double *constants, const double *r, fb_work *restrict w)
{
#ifdef FB_RECURSIVE
    w->factors.constants = constants;
#endif
    const int status = fb_factor(w->mass_matrix, w->constraint_jacobian, w->forcing, &w->factors);
#if !defined(FB_SPARSE) && !defined(FB_RECURSIVE)
    if (N_RANK < N_C && status == FB_OK && w->factors.left > FB_REDUNDANCY_RTOL) {
        double positions[FB_AT_LEAST_1(N_H)], slopes[FB_AT_LEAST_1(N_H * N_Q)], scale[FB_AT_LEAST_1(N_H)];
        double unused[2][FB_AT_LEAST_1(N_C + N_I)];
        position(t, x, constants, r, positions, slopes);
        constraint_scale(t, x, constants, r, scale, unused[0], unused[1]);
        /* The effect of a violation on rows grows by the division by pivots. */
        const double inverse = N_RANK > 0 ? fabs(w->factors.inverse[FB_AT_LEAST_1(N_RANK) - 1]) : 1.0;
        if (!(w->factors.left <= FB_REDUNDANCY_RTOL + FB_OPEN_FACTOR * inverse * fb_violation(positions, scale, N_H)))
            return FB_CONSTRAINTS_INDEPENDENT;
    }
#else
    (void)t, (void)x, (void)constants, (void)r;
#endif
    return status;
}

/* u' for known factors; with unknown forces, also lambda and these. */
static inline int solve_once(double t, const double *restrict x, const double *restrict constants,
                             const double *restrict r, double *restrict rates, fb_work *restrict w)
{
#if N_N > 0
    return fb_solve_with_forces(t, x, constants, r, w->mass_matrix, w->forcing, w->acceleration_bias, &w->factors,
                                &w->response, rates, w->multipliers);
#else
    (void)t, (void)x, (void)constants, (void)r;
    return fb_solve_first(w->forcing, w->acceleration_bias, &w->factors, rates);
#endif
}

#ifndef FB_SPARSE /* which has no redundant rows */
/* The size of the terms of gamma, quadratic in the speeds. For a constraint Phi = 0 whose terms have the size l, and
 * those of its rate the size v, it is v^2 / l. */
static inline double terms_of_bias(double t, const double *x, const double *constants, const double *r,
                                   const double *scale, const int *row)
{
    double unused[FB_AT_LEAST_1(N_H)], lengths[FB_AT_LEAST_1(N_C + N_I)], speeds[FB_AT_LEAST_1(N_C)], size = 0.0;
    constraint_scale(t, x, constants, r, unused, lengths, speeds);
    for (int i = 0; i < N_C; ++i)
        if (lengths[row[i]] > 0.0)
            size = fb_max(size, scale[i] * speeds[row[i]] * speeds[row[i]] / lengths[row[i]]);
    return size;
}
#endif

/* u' at a state whose equations are set up and factored. */
static inline int solve_factored(double t, const double *restrict x, const double *restrict constants,
                                 const double *restrict r, double *restrict rates, fb_work *restrict w)
{
    int status = solve_once(t, x, constants, r, rates, w);
#ifndef FB_SPARSE
    if (N_RANK < N_C && status == FB_CONSTRAINTS_DEPENDENT) {
#ifdef FB_RECURSIVE
        fb_dense_factors *const s = &w->factors.dense;
#else
        fb_factors *const s = &w->factors;
#endif
        s->terms = terms_of_bias(t, x, constants, r, s->scale, s->row);
        status = solve_once(t, x, constants, r, rates, w);
    }
#endif
    return status;
}

static inline int solve_accelerations(double t, const double *restrict x, const double *restrict constants,
                                      const double *restrict r, double *restrict coordinate_rates,
                                      double *restrict rates, fb_work *restrict w)
{
    dynamics(t, x, constants, r, coordinate_rates, w->mass_matrix, w->forcing, w->constraint_jacobian,
             w->acceleration_bias);
    const int status = factor_at(t, x, constants, r, w);
    if (status != FB_OK)
        return status;
    return solve_factored(t, x, constants, r, rates, w);
}

/* z', for a solution u'. */
static inline void fill_state_rates(double t, const double *restrict x, const double *restrict constants,
                                    const double *restrict r, double *restrict rates, fb_work *restrict w)
{
#if defined(FB_STATES_NEED_MULTIPLIERS) && N_N == 0
    fb_multipliers(w->mass_matrix, w->forcing, rates + N_Q, &w->factors, w->multipliers);
#endif
#if N_Z > 0
    state_rates(t, x, constants, r, rates + N_Q, w->multipliers, rates + N_Q + N_U);
#else
    (void)t, (void)x, (void)constants, (void)r, (void)rates, (void)w;
#endif
}

#if defined(FB_RHS_ONLY) || defined(FB_WITHOUT_RHS)
#define FB_RHS FB_TABLE(rhs)
fb_evaluation FB_RHS;
#else
#define FB_RHS rhs
static fb_evaluation FB_RHS;
#endif

#ifndef FB_WITHOUT_RHS
FB_FLATTEN int FB_RHS(double t, const double *x, const double *constants, const double *r, double *rates, void *work)
{
    fb_work *const w = work;
    double *const coordinate_rates = N_Q > 0 ? rates : w->coordinate_rates;
    const int status = solve_accelerations(t, x, constants, r, coordinate_rates, rates + N_Q, w);
    if (status != FB_OK)
        return status;
    fill_state_rates(t, x, constants, r, rates, w);
    return all_finite(rates, N_X);
}
#endif

#ifndef FB_RHS_ONLY
static int stabilized(double t, const double *x, const double *constants, const double *r, double a, double *rates,
                      void *work)
{
    fb_work *const w = work;
    double positions[FB_AT_LEAST_1(N_C + N_I)], velocities[FB_AT_LEAST_1(N_C)];
    dynamics(t, x, constants, r, w->coordinate_rates, w->mass_matrix, w->forcing, w->constraint_jacobian,
             w->acceleration_bias);
    constraint_violation(t, x, constants, r, positions, velocities);
    for (int i = 0; i < N_C; ++i)
        w->acceleration_bias[i] += 2.0 * a * velocities[i] + a * a * positions[i];
    int status = factor_at(t, x, constants, r, w);
    if (status == FB_OK)
        status = solve_factored(t, x, constants, r, rates + N_Q, w);
    for (int i = 0; i < N_Q; ++i)
        rates[i] = w->coordinate_rates[i];
    if (status == FB_OK)
        fill_state_rates(t, x, constants, r, rates, w);
    return status == FB_OK ? all_finite(rates, N_X) : status;
}

static int accelerations(double t, const double *x, const double *constants, const double *r, double *rates,
                         double *multipliers, void *work)
{
    fb_work *const w = work;
    const int status = solve_accelerations(t, x, constants, r, w->coordinate_rates, rates, w);
    if (status != FB_OK)
        return status;
#if N_N > 0
    for (int i = 0; i < N_L; ++i)
        multipliers[i] = w->multipliers[i];
#else
    fb_multipliers(w->mass_matrix, w->forcing, rates, &w->factors, multipliers);
#endif
    return all_finite(rates, N_U) == FB_OK ? all_finite(multipliers, N_L) : FB_NOT_FINITE;
}

/* Constraint stabilization by mass-orthogonal projection: Newton's method with the factors of a state nearby. The
 * change v with J v = -Phi of minimum norm in the metric of M solves M v = J^T lambda, J v + Phi = 0. These are the
 * equations of motion with other right-hand sides; q changes by K v. Likewise for the speeds, with J u + b. Rows that
 * keep no position have 0 for Phi. Invariants have a correction of their own.
 */
static int project(double t, double *x, const double *constants, const double *r, int factors_valid, void *work)
{
    static const double at_rest[N_U] = {0.0};
    fb_work *const w = work;
    double positions[FB_AT_LEAST_1(N_C + N_I)], velocities[FB_AT_LEAST_1(N_C)], change[N_U];
    double position_scale[FB_AT_LEAST_1(N_C + N_I)], velocity_scale[FB_AT_LEAST_1(N_C)], unused[FB_AT_LEAST_1(N_H)];
    double coordinate_changes[FB_AT_LEAST_1(N_Q)], correction[FB_AT_LEAST_1(N_Q)] = {0.0};
    if (N_C + N_I == 0)
        return FB_OK;
#ifdef FB_RECURSIVE
    w->factors.constants = constants;
#endif
    w->drift = INFINITY;
    for (int attempt = 0; attempt < MAX_FACTORIZATIONS; ++attempt) {
        int status = FB_OK;
        if (attempt > 0 || !factors_valid) {
            dynamics(t, x, constants, r, w->coordinate_rates, w->mass_matrix, w->forcing, w->constraint_jacobian,
                     w->acceleration_bias);
            status = factor_at(t, x, constants, r, w);
        }
        constraint_scale(t, x, constants, r, unused, position_scale, velocity_scale);
        double last = INFINITY;
        for (int i = 0; i < MAX_CORRECTIONS; ++i) {
            constraint_violation(t, x, constants, r, positions, velocities);
            const double position = fb_violation(positions, position_scale, N_C + N_I);
            const double velocity = fb_violation(velocities, velocity_scale, N_C);
            if (position != position || velocity != velocity)
                return FB_NOT_FINITE;
            const double size = fb_max(position, velocity);
            if (i == 0 && status == FB_OK && (attempt > 0 || !factors_valid))
                w->drift = size;
            /* The first correction of the positions may increase the violation of velocities. */
            const int stagnates = i > 1 && !(size < 0.5 * last);
            if (size <= FB_CLOSURE_RTOL || (size <= FB_LOOSE_CLOSURE_RTOL && stagnates))
                return status == FB_NOT_FINITE ? status : FB_OK;
            /* Tested after the violations, since closed states at singular positions are accepted. */
            if (status != FB_OK)
                return status;
            if (stagnates)
                break;
            last = size;
            fb_solve(at_rest, positions, &w->factors, change);
            coordinate_change(t, x, constants, r, change, coordinate_changes);
            fb_solve(at_rest, velocities, &w->factors, change);
            if (N_I > 0)
                invariant_correction(t, x, constants, r, correction);
            for (int j = 0; j < N_Q; ++j)
                x[j] += coordinate_changes[j] + correction[j];
            for (int j = 0; j < N_U; ++j)
                x[N_Q + j] += change[j];
        }
    }
    return FB_NOT_CLOSED;
}

static int toggled(void *work)
{
    fb_work *const w = work;
    int result = 0;
#ifndef FB_SPARSE
    if (N_C > 0 && N_RANK == N_C) {
        /* Near a pole of J, units grow without bound. */
        w->largest_pivot /= fb_note_units(w->constraint_jacobian, &w->units);
        const int *const columns = fb_dependent_columns(w->constraint_jacobian, &w->factors);
        if (columns == NULL)
            return 1;
        const double now = fb_signed_pivot(w->constraint_jacobian, &w->units, columns);
        result = fabs(now) < FB_NEAR_SINGULAR_RATIO * w->largest_pivot &&
                 fb_is_near_singular(w->constraint_jacobian, &w->units, w->largest_pivot);
        if (w->largest_pivot > 0.0) {
            /* It is known if both have the static pivot order. */
            const int known = fb_is_static(&w->factors) && w->was_static;
            result |=
                now * (known ? w->signed_pivot_before : fb_signed_pivot(w->jacobian_before, &w->units, columns)) < 0.0;
        }
        double changed = 0.0, size = 0.0;
        for (int i = 0; i < N_C; ++i)
            for (int j = 0; j < N_U; ++j) {
                const double entry = w->constraint_jacobian[i * N_U + j];
                const double unit = w->units.row[i] * w->units.column[j];
                if (unit > 0.0) {
                    changed += fabs(entry - w->jacobian_before[i * N_U + j]) / unit;
                    size += fabs(entry) / unit;
                }
                w->jacobian_before[i * N_U + j] = entry;
            }
        result |= w->largest_pivot > 0.0 && changed > size;
        w->signed_pivot_before = now;
        w->was_static = fb_is_static(&w->factors);
        w->largest_pivot = fb_max(fabs(now), w->largest_pivot);
    }
#else
    (void)w;
#endif
    return result;
}

#if N_Z + N_N == 0
/* A column of the multipliers' derivatives, for one of the accelerations'. Not inline, since it is rarely needed. */
FB_PART static void store_multipliers(const fb_work *w, const double *forcing, const double *accelerations, const int n,
                                      double *column)
{
    double multipliers[FB_AT_LEAST_1(N_C)];
    fb_multipliers(w->mass_matrix, forcing, accelerations, &w->factors, multipliers);
    for (int i = 0; i < N_C; ++i)
        column[i * n] = multipliers[i];
}
#endif

/* Differentiating M u' = f + J^T lambda and J u' + gamma = 0 in some direction gives equations for the changes of u'
 * and lambda with the same matrices; the right-hand sides are the n columns of `residual`. The rows of z' there are
 * completed with these changes. The equations are those of the last call of `accelerations`. */
static int solve_columns(const fb_function *functions, const int n, double t, const double *x, const double *constants,
                         const double *r, const double *residual, double *matrix, double *multiplier_jacobian,
                         fb_work *w)
{
    (void)t, (void)x, (void)constants, (void)r; /* used with unknown forces and state equations */
#if N_N > 0
    fb_response *const s = &w->response;
    if (!fb_evaluate_forces(t, x, constants, r, w->multipliers + N_C, s))
        return FB_NOT_FINITE;
    fb_form_response(w->mass_matrix, &w->factors, s);
#endif
#if N_Z + N_N > 0
    double multipliers[FB_AT_LEAST_1(N_L)];
#endif
#if N_Z > 0
    const fb_at held = {t, x, constants, r, w->accelerations, w->multipliers, 0};
    double *const of_state_rates[] = {w->state_rate_acceleration_jacobian, w->state_rate_multiplier_jacobian};
    functions[FB_STATE_RATE_PARTIALS].call(&held, NULL, of_state_rates, w);
#else
    (void)functions;
#endif
#ifdef FB_RECURSIVE
    if (!w->factors.is_dense) {
        fb_solve_columns(residual, n, &w->factors, matrix + N_Q * n);
        if (N_Z + N_N == 0 && multiplier_jacobian == NULL)
            return all_finite(matrix, N_X * n);
    }
#endif
    for (int j = 0; j < n; ++j) {
        double forcing[N_U], bias[FB_AT_LEAST_1(N_C)], solution[N_U];
        for (int i = 0; i < N_U; ++i)
            forcing[i] = residual[i * n + j];
        for (int i = 0; i < N_C; ++i)
            bias[i] = -residual[(N_U + i) * n + j];
#ifdef FB_RECURSIVE
        for (int i = 0; i < N_U; ++i)
            solution[i] = matrix[(N_Q + i) * n + j];
        if (w->factors.is_dense)
#endif
            /* Redundant rows hold in every direction in which the state can move; the status for others is ignored. */
            fb_solve(forcing, bias, &w->factors, solution);
#if N_Z + N_N > 0
        fb_multipliers(w->mass_matrix, forcing, solution, &w->factors, multipliers);
#endif
#if N_N > 0
        double unused = 0.0, *const forces = multipliers + N_C;
        for (int i = 0; i < N_N; ++i)
            forces[i] = fb_auxiliary_row(s, i, residual[(N_U + N_C + i) * n + j], solution, multipliers, &unused);
        const int found = fb_respond(s, forces, solution, multipliers);
        if (found != FB_OK)
            return found;
#endif
#if N_Z + N_N > 0
        for (int i = 0; i < N_L && multiplier_jacobian; ++i)
            multiplier_jacobian[i * n + j] = multipliers[i];
#else
        if (multiplier_jacobian)
            store_multipliers(w, forcing, solution, n, multiplier_jacobian + j);
#endif
        for (int i = 0; i < N_U; ++i)
            matrix[(N_Q + i) * n + j] = solution[i];
#if N_Z > 0
        for (int i = 0; i < N_Z; ++i) {
            double sum = residual[(N_U + N_L + i) * n + j];
            for (int k = 0; k < N_U; ++k)
                sum += w->state_rate_acceleration_jacobian[i * N_U + k] * solution[k];
            for (int k = 0; k < N_L; ++k)
                sum += w->state_rate_multiplier_jacobian[i * N_L + k] * multipliers[k];
            matrix[(N_Q + N_U + i) * n + j] = sum;
        }
#endif
    }
    return all_finite(matrix, N_X * n);
}

static int differentiate(const fb_function *functions, enum FB_ROLE role, int n, double t, const double *x,
                         const double *constants, const double *r, double *matrix, double *multiplier_jacobian,
                         void *work)
{
    fb_work *const w = work;
    const int status = accelerations(t, x, constants, r, w->accelerations, w->multipliers, work);
    if (status != FB_OK)
        return status;
    const fb_at at = {t, x, constants, r, w->accelerations, w->multipliers, 0};
    double *const partials[] = {matrix, w->residual_jacobian};
    functions[role].call(&at, NULL, partials, work);
    return solve_columns(functions, n, t, x, constants, r, w->residual_jacobian, matrix, multiplier_jacobian, w);
}

#ifndef FB_LIBRARY
static int jvp(const fb_function *functions, double t, const double *x, const double *constants, const double *r,
               const double *known, int n, const double *directions, double *rates, void *work)
{
    fb_work *const w = work;
    if (known == NULL) {
        const int status = accelerations(t, x, constants, r, w->accelerations, w->multipliers, work);
        if (status != FB_OK)
            return status;
    } else {
        for (int i = 0; i < N_U; ++i)
            w->accelerations[i] = known[i];
#if N_N == 0
        fb_multipliers(w->mass_matrix, w->forcing, known, &w->factors, w->multipliers);
#endif
    }
    const fb_at at = {t, x, constants, r, w->accelerations, w->multipliers, n};
    double *const products[] = {rates, w->residual_tangent};
    functions[FB_RESIDUAL_JVP].call(&at, &directions, products, work);
#if !defined(FB_SPARSE) && !defined(FB_RECURSIVE) && N_Z + N_N == 0
    fb_solve_directions(n, w->residual_tangent, &w->factors, rates + N_Q * n);
    return all_finite(rates, N_X * n);
#else
    return solve_columns(functions, n, t, x, constants, r, w->residual_tangent, rates, NULL, w);
#endif
}

/* u' for n right-hand sides (f, -gamma) in the columns of a matrix. */
static void solve_directions(int n, const double *sides, const fb_work *w, double *solutions)
{
#ifdef FB_RECURSIVE
    if (!w->factors.is_dense) {
        fb_solve_columns(sides, n, &w->factors, solutions);
        return;
    }
#endif
#if !defined(FB_SPARSE) && !defined(FB_RECURSIVE)
    fb_solve_directions(n, sides, &w->factors, solutions);
#else
    for (int j = 0; j < n; ++j) {
        double forcing[N_U], bias[FB_AT_LEAST_1(N_C)], solution[N_U];
        for (int i = 0; i < N_U; ++i)
            forcing[i] = sides[i * n + j];
        for (int i = 0; i < N_C; ++i)
            bias[i] = -sides[(N_U + i) * n + j];
        fb_solve(forcing, bias, &w->factors, solution);
        for (int i = 0; i < N_U; ++i)
            solutions[i * n + j] = solution[i];
    }
#endif
}

/* The changes of coordinates and speeds that lead along directions onto the constraints' tangent: those of `project`
 * for the derivatives of the violations, by the same orthogonality. */
static int projection_jvp(const fb_function *functions, double t, const double *x, const double *constants,
                          const double *r, enum FB_LAST last, int n, double *directions, void *work)
{
    fb_work *const w = work;
    /* f = 0, then the violations: in solutions for -gamma, signs are reversed */
    double sides[(N_U + FB_AT_LEAST_1(N_C + N_I)) * FB_DIRECTIONS] = {0.0}, unused[FB_AT_LEAST_1(N_C) * FB_DIRECTIONS];
    double *const violations = sides + N_U * n;
    double changes[N_U * FB_DIRECTIONS], change[N_U], coordinate_changes[FB_AT_LEAST_1(N_Q)];
    const fb_at at = {t, x, constants, r, NULL, NULL, n};
    const double *const given[] = {directions};
    if (N_C + N_I == 0)
        return FB_OK;
    if (!(last == FB_LAST_RHS || (last == FB_LAST_PROJECT && w->drift <= FB_SLIGHT_DRIFT_RTOL))) {
        dynamics(t, x, constants, r, w->coordinate_rates, w->mass_matrix, w->forcing, w->constraint_jacobian,
                 w->acceleration_bias);
        const int status = factor_at(t, x, constants, r, w);
        if (status != FB_OK)
            return status;
    }
    double *const of_positions[] = {violations, unused};
    functions[FB_CONSTRAINT_JVP].call(&at, given, of_positions, work);
    solve_directions(n, sides, w, changes);
    for (int j = 0; j < n; ++j) {
        for (int i = 0; i < N_U; ++i)
            change[i] = changes[i * n + j];
        coordinate_change(t, x, constants, r, change, coordinate_changes);
        for (int i = 0; i < N_Q; ++i)
            directions[i * n + j] -= coordinate_changes[i];
    }
    /* The speeds' constraints depend on the coordinates as well. */
    double positions[FB_AT_LEAST_1(N_C + N_I) * FB_DIRECTIONS];
    double *const of_speeds[] = {positions, violations};
    functions[FB_CONSTRAINT_JVP].call(&at, given, of_speeds, work);
    solve_directions(n, sides, w, changes);
    for (int i = 0; i < N_U * n; ++i)
        directions[N_Q * n + i] -= changes[i];
    return FB_OK;
}

/* With the changes of u' and lambda as in `solve_columns`, and weights a of u' and l of lambda, the weighted sum is
 * that of the residual's rows with weights v and m that solve the transposed equations, M v + J^T m = a, -J v = l.
 * These are the equations of motion with f = a, gamma = l and lambda = -m. Unknown forces n: from G dn = -(their rows).
 */
static int vjp(const fb_function *functions, double t, const double *x, const double *constants, const double *r,
               const double *weights, double *gradient, void *work)
{
    fb_work *const w = work;
    const int status = accelerations(t, x, constants, r, w->accelerations, w->multipliers, work);
    if (status != FB_OK)
        return status;
    double of_accelerations[N_U], of_multipliers[FB_AT_LEAST_1(N_L)], rows[N_Q + N_U + N_L + N_Z];
    double *const of_residual = rows + N_Q;
    for (int i = 0; i < N_Q; ++i)
        rows[i] = weights[i];
    for (int i = 0; i < N_U; ++i)
        of_accelerations[i] = weights[N_Q + i];
    for (int i = 0; i < N_L; ++i)
        of_multipliers[i] = weights[N_X + i];
#if N_Z > 0
    const fb_at held = {t, x, constants, r, w->accelerations, w->multipliers, 0};
    double *const of_state_rates[] = {w->state_rate_acceleration_jacobian, w->state_rate_multiplier_jacobian};
    functions[FB_STATE_RATE_PARTIALS].call(&held, NULL, of_state_rates, w);
    for (int k = 0; k < N_Z; ++k) {
        const double weight = of_residual[N_U + N_L + k] = weights[N_Q + N_U + k];
        for (int i = 0; i < N_U; ++i)
            of_accelerations[i] += w->state_rate_acceleration_jacobian[k * N_U + i] * weight;
        for (int i = 0; i < N_L; ++i)
            of_multipliers[i] += w->state_rate_multiplier_jacobian[k * N_L + i] * weight;
    }
#endif
#if N_N > 0
    fb_response *const s = &w->response;
    if (!fb_evaluate_forces(t, x, constants, r, w->multipliers + N_C, s))
        return FB_NOT_FINITE;
    fb_form_response(w->mass_matrix, &w->factors, s);
    const int found = fb_forces_vjp(s, of_accelerations, of_multipliers, of_residual + N_U + N_C);
    if (found != FB_OK)
        return found;
#endif
    /* Redundant rows: gradients along the tangent do not depend on which of their multipliers are taken. */
    fb_solve(of_accelerations, of_multipliers, &w->factors, of_residual);
    fb_multipliers(w->mass_matrix, of_accelerations, of_residual, &w->factors, of_residual + N_U);
    for (int i = 0; i < N_C; ++i)
        of_residual[N_U + i] *= -1.0;
    const fb_at at = {t, x, constants, r, w->accelerations, w->multipliers, 0};
    const double *const of_rows[] = {rows};
    functions[FB_RESIDUAL_VJP].call(&at, of_rows, &gradient, work);
    return all_finite(gradient, N_X + N_P + N_R);
}

/* The weighted sum of changes v with M v = J^T lambda, J v + w = 0, with weights a, is that of the rows of w with the
 * multipliers of the equations of motion for f = a, gamma = 0. */
static int projection_vjp(const fb_function *functions, double t, const double *x, const double *constants,
                          const double *r, double *gradient, void *work)
{
    fb_work *const w = work;
    static const double at_rest[N_U + N_L + 1] = {0.0};
    double rows[FB_AT_LEAST_1(2 * N_C + N_I)] = {0.0}, of_dynamics[N_Q + N_U + N_L + N_Z] = {0.0}, change[N_U];
    const fb_at at = {t, x, constants, r, at_rest, at_rest, 0};
    const double *const of_violations[] = {rows}, *const of_residual[] = {of_dynamics};
    double *const result[] = {w->gradient};
    if (N_C + N_I == 0)
        return FB_OK;
#ifdef FB_RECURSIVE
    w->factors.constants = constants;
#endif
    dynamics(t, x, constants, r, w->coordinate_rates, w->mass_matrix, w->forcing, w->constraint_jacobian,
             w->acceleration_bias);
    const int status = factor_at(t, x, constants, r, w);
    if (status != FB_OK)
        return status;
    /* the speeds, which projection_jvp moves last */
    fb_solve(gradient + N_Q, at_rest, &w->factors, change);
    fb_multipliers(w->mass_matrix, gradient + N_Q, change, &w->factors, rows + N_C + N_I);
    functions[FB_CONSTRAINT_VJP].call(&at, of_violations, result, work);
    for (int i = 0; i < N_X + N_P + N_R; ++i)
        gradient[i] += w->gradient[i];
    /* the coordinates: q' = K u + k, so K^T is in the derivatives of q' with respect to u */
    for (int i = 0; i < N_Q; ++i)
        of_dynamics[i] = gradient[i];
    functions[FB_RESIDUAL_VJP].call(&at, of_residual, result, work);
    fb_solve(w->gradient + N_Q, at_rest, &w->factors, change);
    for (int i = 0; i < 2 * N_C + N_I; ++i)
        rows[i] = 0.0;
    fb_multipliers(w->mass_matrix, w->gradient + N_Q, change, &w->factors, rows);
    functions[FB_CONSTRAINT_VJP].call(&at, of_violations, result, work);
    for (int i = 0; i < N_X + N_P + N_R; ++i)
        gradient[i] += w->gradient[i];
    return all_finite(gradient, N_X + N_P + N_R);
}
#endif

#ifndef FB_LIBRARY /* which calls the functions themselves */
static const fb_array dynamics_results[5] = {{"coordinate_rates", N_Q, FB_VECTOR},
                                             {"mass_matrix", N_U, N_U},
                                             {"forcing", N_U, FB_VECTOR},
                                             {"constraint_jacobian", N_C, N_U},
                                             {"acceleration_bias", N_C, FB_VECTOR}};
static int call_dynamics(const fb_at *at, const double *const *arguments, double *const *results, void *work)
{
    (void)arguments, (void)work;
    full_dynamics(at->t, at->x, at->constants, at->r, results[0], results[1], results[2], results[3], results[4]);
    return FB_OK;
}
#endif

const fb_kernel FB_TABLE(kernel) = {
    .abi_version = FB_ABI_VERSION,
    .struct_size = sizeof(fb_kernel),
    .n_roles = FB_N_ROLES,
    .work_size = sizeof(fb_work),
    .n_q = N_Q,
    .n_u = N_U,
    .n_z = N_Z,
    .n_x = N_X,
    .n_p = N_P,
    .n_r = N_R,
    .n_h = N_H,
    .n_c = N_C,
    .n_l = N_L,
    .n_i = N_I,
    .n_o = N_O,
    .n_breakpoints = N_BREAKPOINTS,
    .n_points = N_POINTS,
    .n_forces = N_FORCES,
    .n_constants = N_CONSTANTS,
    .position_row = position_row,
    .prepare = prepare,
    .default_inputs = default_inputs,
    .rhs = FB_RHS,
    .stabilized = stabilized,
    .differentiate = differentiate,
#ifndef FB_LIBRARY
    .jvp = jvp,
    .projection_jvp = projection_jvp,
    .vjp = vjp,
    .projection_vjp = projection_vjp,
#endif
    .accelerations = accelerations,
#ifdef FB_STATES_NEED_SOLUTION
    .states_need_solution = 1,
#endif
    .dynamics = full_dynamics,
    .position = position,
    .velocity = velocity,
    .constraint_violation = constraint_violation,
    .coordinate_change = coordinate_change,
    .project = project,
    .toggled = toggled,
#ifndef FB_LIBRARY
    .functions = own_functions,
#endif
#ifdef FB_LIBRARY             /* derivatives are called by a source of their own, which may be left out */
#elif defined(FB_ONE_MACHINE) /* other parts can be built when they are needed */
    .one_machine = 1,
#ifdef FB_HAS_BATCH_FUNCTIONS
    .batch_functions_apart = 1,
#endif
#else
    .derivatives = &FB_DERIVATIVES,
    .products = &FB_TABLE(products),
#ifdef FB_HAS_BATCH_FUNCTIONS
    .batch_functions = &FB_TABLE(batch_functions),
    .instructions = FB_INSTRUCTIONS,
    .faster = FB_FASTER,
#endif
#endif
};
#endif
