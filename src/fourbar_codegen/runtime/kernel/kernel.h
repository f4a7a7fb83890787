/* The part of a kernel that is the same for every model: it solves the equations from the generated functions.
 *
 * Included once, at the end of a generated source, which defines N_Q, N_U, ..., the functions `prepare` to
 * `output`, and the names of tables: FB_TABLE(kernel), FB_TABLE(batch_functions), and FB_DERIVATIVES, which is in
 * another source. A kernel may be compiled in two units in parallel: FB_RHS_ONLY has the right-hand side, which takes
 * longest, and FB_WITHOUT_RHS everything else.
 */
#include "solution.h"

#ifndef FB_RHS_ONLY
#include "projection.h"
#include "solution_derivatives.h"

/* Whether a singular position may have been passed since the last call. */
static int toggled(void *work)
{
    fb_work *const w = work;
    return fb_note_pivots(w->constraint_jacobian, &w->factors, &w->pivots);
}

static double least_pivot(double t, const double *x, const double *constants, const double *r, enum FB_LOOK look,
                          void *work)
{
    return fb_least_pivot(t, x, constants, r, look, &((fb_work *)work)->pivots);
}

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
    .n_conditions = N_CONDITIONS,
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
#ifdef FB_OUTPUTS_NEED_SOLUTION
    .outputs_need_solution = 1,
#endif
#ifdef FB_OUTPUTS_NEED_INPUTS
    .outputs_need_inputs = 1,
#endif
    .dynamics = full_dynamics,
    .position = position,
    .velocity = velocity,
    .constraint_violation = constraint_violation,
    .coordinate_change = coordinate_change,
    .project = project,
    .toggled = toggled,
    .least_pivot = N_RANK > 0 ? least_pivot : NULL,
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
