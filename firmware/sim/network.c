/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* A linear network of resistors and capacitors, solved exactly over any time.
 *
 * C dv/dt = -G v + i, with C and G symmetric, C positive definite. With C = L L' and
 * L^-1 G L^-T = Q diag(rate) Q', the modes z = Q' L' v do not know each other:
 * dz/dt = -rate z + (L^-T Q)' i.
 */
#include "skinsim.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

struct modes {
    size_t n;
    double *rate, *to, *from; /* (n), and (n, n): z = to v, v = from z */
};

/* L of a symmetric matrix, in its lower half. */
static void cholesky(size_t n, double a[n][n]) {
    for (size_t j = 0; j < n; j++)
        for (size_t i = j; i < n; i++) {
            for (size_t k = 0; k < j; k++)
                a[i][j] -= a[i][k] * a[j][k];
            a[i][j] /= i == j ? sqrt(a[j][j]) : a[j][j];
        }
}

/* The columns of b become L^-1 b. */
static void solve_lower(size_t n, double l[n][n], double b[n][n]) {
    for (size_t i = 0; i < n; i++) {
        for (size_t k = 0; k < i; k++)
            for (size_t j = 0; j < n; j++)
                b[i][j] -= l[i][k] * b[k][j];
        for (size_t j = 0; j < n; j++)
            b[i][j] /= l[i][i];
    }
}

static void transpose(size_t n, double a[n][n]) {
    for (size_t i = 0; i < n; i++)
        for (size_t j = 0; j < i; j++) {
            const double kept = a[i][j];
            a[i][j] = a[j][i];
            a[j][i] = kept;
        }
}

/* Householder's reflections make `a` tridiagonal: its diagonal d, beside it e[1] to e[n-1]. The
 * rows of `a` become the reflections' product. */
static void tridiagonal(size_t n, double a[n][n], double d[n], double e[n]) {
    double u[n], p[n], q[n][n];
    memset(q, 0, sizeof q);
    for (size_t i = 0; i < n; i++)
        q[i][i] = 1;
    for (size_t k = 0; k + 2 < n; k++) {
        double norm = 0, up = 0;
        for (size_t i = k + 1; i < n; i++)
            norm += a[i][k] * a[i][k];
        if (norm == 0)
            continue;
        norm = sqrt(norm);
        for (size_t i = k + 1; i < n; i++)
            u[i] = a[i][k];
        u[k + 1] += copysign(norm, u[k + 1]);
        const double weight = 1 / (norm * fabs(u[k + 1])); /* 2 / u'u */
        memset(p, 0, sizeof p);
        for (size_t j = k + 1; j < n; j++)
            for (size_t i = k; i < n; i++)
                p[i] += weight * u[j] * a[j][i];
        for (size_t i = k + 1; i < n; i++)
            up += weight / 2 * u[i] * p[i];
        for (size_t i = k + 1; i < n; i++)
            p[i] -= up * u[i];
        for (size_t i = k + 1; i < n; i++) {
            a[i][k] = a[k][i] = a[i][k] - u[i] * p[k];
            for (size_t j = k + 1; j < n; j++)
                a[i][j] -= u[i] * p[j] + p[i] * u[j];
        }
        memset(p, 0, sizeof p); /* q = (1 - weight u u') q */
        for (size_t i = k + 1; i < n; i++)
            for (size_t j = 0; j < n; j++)
                p[j] += weight * u[i] * q[i][j];
        for (size_t i = k + 1; i < n; i++)
            for (size_t j = 0; j < n; j++)
                q[i][j] -= u[i] * p[j];
    }
    for (size_t i = 0; i < n; i++) {
        d[i] = a[i][i];
        e[i] = i ? a[i][i - 1] : 0;
    }
    memcpy(a, q, sizeof q);
}

/* Implicit QL steps with Wilkinson's shift: d becomes the eigenvalues, and the rows of q, turned
 * with it, the eigenvectors. */
static void diagonalise(size_t n, double d[n], double e[n], double q[n][n]) {
    for (size_t i = 1; i < n; i++)
        e[i - 1] = e[i];
    e[n - 1] = 0;
    for (size_t l = 0; l < n; l++)
        for (;;) {
            size_t m = l;
            while (m + 1 < n && fabs(e[m]) > 2e-16 * (fabs(d[m]) + fabs(d[m + 1])))
                m++;
            if (m == l)
                break;
            const double half = (d[l + 1] - d[l]) / (2 * e[l]);
            double g = d[m] - d[l] + e[l] / (half + copysign(hypot(half, 1), half));
            double s = 1, c = 1, p = 0;
            size_t i = m;
            while (i-- > l) {
                const double f = s * e[i], b = c * e[i], r = sqrt(f * f + g * g);
                e[i + 1] = r;
                if (r == 0) {
                    d[i + 1] -= p;
                    e[m] = 0;
                    break;
                }
                s = f / r;
                c = g / r;
                const double base = d[i + 1] - p, turn = (d[i] - base) * s + 2 * c * b;
                p = s * turn;
                d[i + 1] = base + p;
                g = c * turn - b;
                for (size_t k = 0; k < n; k++) {
                    const double upper = q[i + 1][k];
                    q[i + 1][k] = s * q[i][k] + c * upper;
                    q[i][k] = c * q[i][k] - s * upper;
                }
            }
            if (i + 1 != l)
                continue; /* a step that was cut short by r == 0 */
            d[l] -= p;
            e[l] = g;
            e[m] = 0;
        }
}

struct modes *modes_make(size_t n, const double *farad, const double *siemens) {
    struct modes *modes = malloc(sizeof *modes + (n + 2 * n * n) * sizeof(double));
    if (!modes)
        abort();
    modes->n = n;
    modes->rate = (double *)(modes + 1);
    modes->to = modes->rate + n;
    modes->from = modes->to + n * n;
    double l[n][n], q[n][n], e[n];
    memcpy(l, farad, sizeof l);
    memcpy(q, siemens, sizeof q);
    cholesky(n, l);
    solve_lower(n, l, q);
    transpose(n, q);
    solve_lower(n, l, q);
    tridiagonal(n, q, modes->rate, e);
    diagonalise(n, modes->rate, e, q);
    memset(modes->to, 0, n * n * sizeof(double));
    memcpy(modes->from, q, sizeof q);
    transpose(n, l);
    for (size_t mode = 0; mode < n; mode++) {
        double *to = modes->to + mode * n, *from = modes->from + mode * n;
        for (size_t k = 0; k < n; k++) /* to = Q' L' */
            for (size_t j = k; j < n; j++)
                to[j] += q[mode][k] * l[k][j];
        for (size_t k = n; k-- > 0;) { /* from, transposed: L' from' = Q */
            from[k] /= l[k][k];
            for (size_t j = 0; j < k; j++)
                from[j] -= l[j][k] * from[k];
        }
    }
    return modes;
}

void modes_advance(const struct modes *modes, const double *ampere, double seconds, double *volt) {
    const size_t n = modes->n;
    double after[n];
    memset(after, 0, sizeof after);
    for (size_t mode = 0; mode < n; mode++) {
        const double *to = modes->to + mode * n, *from = modes->from + mode * n;
        double z = 0, drive = 0;
        for (size_t j = 0; j < n; j++) {
            z += to[j] * volt[j];
            drive += from[j] * ampere[j];
        }
        const double rate = modes->rate[mode], gone = -expm1(-rate * seconds);
        z += fabs(rate * seconds) < 1e-12 ? drive * seconds : (drive / rate - z) * gone;
        for (size_t j = 0; j < n; j++)
            after[j] += from[j] * z;
    }
    memcpy(volt, after, sizeof after);
}
