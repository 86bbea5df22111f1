/* LU of small dense matrices, row-major, and what is solved with it; entries that are zero cost nothing. */

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define THRESHOLD 0.1                       /* of a column's largest entry: a diagonal entry above it is the pivot */

/* in place; the diagonal is the pivot from the share `least` of its column's largest entry on, 1 for partial pivoting; returns 0
   where the matrix is singular or not finite */
static inline int factor(int n, double least, double *a, int *pivot) {
    for (int k = 0; k < n; k++) {
        int best = k;
        double largest = fabs(a[k * n + k]) / least;
        for (int i = k + 1; i < n; i++)
            if (fabs(a[i * n + k]) > largest) largest = fabs(a[i * n + k]), best = i;
        if (!(largest > 0.0) || !(largest <= DBL_MAX)) return 0;
        pivot[k] = best;
        if (best != k)
            for (int j = 0; j < n; j++) {
                double swap = a[k * n + j];
                a[k * n + j] = a[best * n + j];
                a[best * n + j] = swap;
            }
        double inverse = 1.0 / a[k * n + k];
        for (int i = k + 1; i < n; i++) {
            double f = a[i * n + k] *= inverse;
            if (f == 0.0) continue;
            for (int j = k + 1; j < n; j++) a[i * n + j] -= f * a[k * n + j];
        }
    }
    return 1;
}

/* columns of b (n x m) are solved in place; `rows` (n) says which of its rows belongs to each unknown, NULL for the same one */
static inline void solve(int n, const double *a, const int *pivot, const int *rows, double *b, int m) {
#define ROW_OF(k) (b + (rows ? rows[k] : (k)) * m)
    for (int k = 0; k < n; k++)
        if (pivot[k] != k) {
            double *one = ROW_OF(k), *other = ROW_OF(pivot[k]);
            for (int j = 0; j < m; j++) {
                double swap = one[j];
                one[j] = other[j];
                other[j] = swap;
            }
        }
    for (int i = 1; i < n; i++) {
        double *to = ROW_OF(i);
        for (int k = 0; k < i; k++) {
            double f = a[i * n + k];
            const double *from = ROW_OF(k);
            if (f == 0.0) continue;
            for (int j = 0; j < m; j++) to[j] -= f * from[j];
        }
    }
    for (int i = n - 1; i >= 0; i--) {
        double *to = ROW_OF(i), inverse = 1.0 / a[i * n + i];
        for (int k = i + 1; k < n; k++) {
            double f = a[i * n + k];
            const double *from = ROW_OF(k);
            if (f == 0.0) continue;
            for (int j = 0; j < m; j++) to[j] -= f * from[j];
        }
        for (int j = 0; j < m; j++) to[j] *= inverse;
    }
#undef ROW_OF
}
